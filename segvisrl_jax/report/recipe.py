"""What of a training run's settings makes the method."""

from typing import Any

from segvisrl_jax.config import BOOKKEEPING, TrainConfig, flatten, to_dict

NOT_LEARNT_FROM = (*BOOKKEEPING, "seed", "evaluation")
WHO_COMPUTES = ("env.renderer", "env.physics.engine", "env.physics.num_threads")


def recipe(config: TrainConfig) -> dict[str, Any]:
    """Settings by their full names, equal for two runs of one method with different seeds.

    Seed, bookkeeping and the choice of the best policy are left out, and who computes what is the same.
    """
    kept = {name: value for name, value in to_dict(config).items() if name not in NOT_LEARNT_FROM}
    return {name: value for name, value in flatten(kept).items() if name not in WHO_COMPUTES}
