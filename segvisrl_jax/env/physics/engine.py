"""What a physics engine must do. ``make_engine`` picks one; native.py and mjx.py are the two there are."""

from typing import Protocol

from jaxtyping import Array, Float32

from segvisrl_jax.types import Action, PhysicsState


class PhysicsEngine(Protocol):
    """Moves the rover for one decision. Stateless to the caller: jit, scan and vmap over everything.

    Rocks and goal are not part of the physics: they are seen, not felt.
    """

    name: str

    def place(self, xy_m: Float32[Array, "2"], yaw_rad: Float32[Array, ""]) -> PhysicsState:
        """The rover at rest on the ground at a place and heading."""
        ...

    def advance(self, state: PhysicsState, action: Action) -> PhysicsState:
        """Drives for one decision with constant wheel speeds.

        Args:
            state: where the rover is, unbatched.
            action: (2,) left and right wheel speed as a share of the top speed; clipped to [0, 1] here.

        Returns:
            The states at the judged instants, stacked: ``qpos`` (J, 11), ``qvel`` (J, 10). A state that diverged is
            non-finite from there on; it is never silently reset.
        """
        ...
