# %% [markdown]
# # Does it matter who draws?
# The shipped `cnn_lstm` drives the same test scenes twice: seeing through `scanline` and through MuJoCo's own renderer.
#
# `python experiments/policy_through_renderers.py [EPISODES]`, by default 40; needs OpenGL. 40 episodes take about a
# minute. Writes no picture.

# %%
import sys

import numpy as np

import segvisrl_jax
from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.config import replace_fields
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.training.evaluation import Evaluator
from segvisrl_jax.training.loop import held_out_env
from segvisrl_jax.training.policy import network_policy
from segvisrl_jax.types import Outcome

IS_SCRIPT = "__file__" in globals()
EPISODES = int(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else 40

# %%
config, params, _ = segvisrl_jax.load_policy("cnn_lstm")
finished = {}
for renderer in ("scanline", "gl"):
    env = segvisrl_jax.RoverEnv(replace_fields(held_out_env(config.env), renderer=renderer))
    network = make_network(config.arch, config.network, env.observation_shape)
    evaluator = Evaluator(env, network_policy(network, config.arch), min(64, EPISODES))
    finished[renderer] = evaluator.run(params, scene_stream(0, TEST_STREAM), EPISODES)

# %%
ours, theirs = finished["scanline"], finished["gl"]
same = ours.outcome == theirs.outcome
apart = np.abs(ours.path_length_m - theirs.path_length_m)
print("| episodes | same outcome | success, scanline | success, gl | path lengths apart, median and largest [m] |")
print("|---|---|---|---|---|")
success = [f"{100 * np.mean(f.outcome == Outcome.SUCCESS):.1f} %" for f in (ours, theirs)]
gap = f"{np.median(apart):.4f}, {apart.max():.3f}"
print(f"| {EPISODES} | {100 * same.mean():.1f} % | {success[0]} | {success[1]} | {gap} |")
