"""The learner: networks, action distribution, advantages, PPO. It knows nothing of environments."""
