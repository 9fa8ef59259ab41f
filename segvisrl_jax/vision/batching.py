"""Images of many environments: one after another on a CPU, all at once on an accelerator."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.backend import backends


def by_platform(*args: Any, cpu: Callable, default: Callable) -> Any:
    """``jax.lax.platform_dependent``, except that ``default`` is not traced where JAX has nothing but a CPU.

    To trace both ways to an image takes four times as long as to trace one.
    """
    if set(backends()) == {"cpu"}:
        return cpu(*args)
    return jax.lax.platform_dependent(*args, cpu=cpu, default=default)


def one_by_one_on_cpu(draw: Callable) -> Callable:
    """``draw`` with a vmap of its own: a loop over environments on a CPU, elsewhere the usual one.

    An image that is finished before the next is begun stays in the cache, and work that it does not need can be
    left out: under the usual vmap, all do what one of them needs.
    """

    draw = jax.jit(draw, inline=True)  # the same program, but JAX traces ``draw`` once and not for every use of it

    @jax.custom_batching.custom_vmap
    def drawn(*args):
        return draw(*args)

    @drawn.def_vmap
    def _(axis_size: int, is_batched, *args):
        def batch(array, has_axis):
            return array if has_axis else jnp.broadcast_to(array, (axis_size, *jnp.shape(array)))

        args = jax.tree.map(batch, args, tuple(is_batched))
        on_cpu = functools.partial(jax.lax.map, lambda one: drawn(*one))
        return by_platform(args, cpu=on_cpu, default=lambda many: jax.vmap(draw)(*many)), True

    return drawn
