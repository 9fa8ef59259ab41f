"""An LSTM that forgets where an episode begins, one step at a time or over a whole trajectory.

The cell and its parameters are flax's ``OptimizedLSTMCell``. ``unroll`` computes the same with fewer, larger matrix
products: what enters from the features is one product before the loop over time, and the gradient of the recurrent
weights is one product behind it, where the derivative of a loop would read and write that whole matrix in every step.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32

Carry = tuple[Float32[Array, "..."], ...]
"""The LSTM's (cell, hidden) state, each (*B, lstm_size); empty for a network without memory."""

GATES = "ifgo"  # input, forget, candidate, output: flax's names and order

State = Float32[Array, "B S"]
States = Float32[Array, "T B S"]
Gates = Float32[Array, "B 4*S"]


class ResettableLSTM(nn.Module):
    """An LSTM whose carry is zeroed where an episode begins, before the cell sees it."""

    size: int

    def setup(self) -> None:
        """Builds the cell (flax's own)."""
        self.cell = nn.OptimizedLSTMCell(self.size, kernel_init=nn.initializers.orthogonal())

    def __call__(
        self, carry: Carry, features: Float32[Array, "B F"], reset: Float32[Array, " B"]
    ) -> tuple[Carry, State]:
        """One step for every environment."""
        return self.cell(_without(reset, carry), features)  # type: ignore[arg-type]

    def unroll(
        self, carry: Carry, features: Float32[Array, "T B F"], reset: Float32[Array, "T B"]
    ) -> tuple[Carry, States]:
        """All steps in time order."""
        params = self.cell.variables["params"]
        by_features = jnp.concatenate([params[f"i{gate}"]["kernel"] for gate in GATES], axis=1)
        by_hidden = jnp.concatenate([params[f"h{gate}"]["kernel"] for gate in GATES], axis=1)
        bias = jnp.concatenate([params[f"h{gate}"]["bias"] for gate in GATES])
        return _recur(by_hidden, features @ by_features + bias, reset, carry)


def _without(reset: Float32[Array, " B"], carry: Carry) -> Carry:
    """The carry, zero where an episode begins, even where it was not finite."""
    return jax.tree.map(lambda part: jnp.where(reset[:, None] > 0, 0.0, part), carry)


@jax.custom_vjp
def _recur(
    by_hidden: Float32[Array, "S 4*S"], entering: Float32[Array, "T B 4*S"], reset: Float32[Array, "T B"], carry: Carry
) -> tuple[Carry, States]:
    """The loop over time: the last carry, and the hidden state after every step."""
    return _recur_forward(by_hidden, entering, reset, carry)[0]


def _recur_forward(by_hidden, entering, reset, carry):
    def step(carry, inputs):
        entering_now, reset_now = inputs
        cell, hidden = _without(reset_now, carry)
        gates = entering_now + hidden @ by_hidden
        after = _cell_step(gates, cell)
        return after, (after[1], gates, cell, hidden)

    last, (hiddens, gates, cells_before, hiddens_before) = jax.lax.scan(step, carry, (entering, reset))
    return (last, hiddens), (by_hidden, reset, gates, cells_before, hiddens_before)


def _recur_backward(residuals, cotangents):
    by_hidden, reset, gates, cells_before, hiddens_before = residuals
    of_last, of_hiddens = cotangents

    def step(of_carry, inputs):
        of_cell, of_hidden = of_carry
        gates_now, cell, reset_now, of_output = inputs
        _, pull = jax.vjp(_cell_step, gates_now, cell)
        of_gates, of_cell = pull((of_cell, of_hidden + of_output))
        return _without(reset_now, (of_cell, of_gates @ by_hidden.T)), of_gates

    inputs = (gates, cells_before, reset, of_hiddens)
    of_first, of_gates = jax.lax.scan(step, of_last, inputs, reverse=True)
    of_weights = jnp.einsum("tbs,tbg->sg", hiddens_before, of_gates)
    return of_weights, of_gates, jnp.zeros_like(reset), of_first


_recur.defvjp(_recur_forward, _recur_backward)


def _cell_step(gates: Gates, cell: State) -> tuple[State, State]:
    """The LSTM's (cell, hidden) after one step, from its four gates before their functions."""
    enter, forget, candidate, leave = jnp.split(gates, len(GATES), axis=-1)
    cell = nn.sigmoid(forget) * cell + nn.sigmoid(enter) * jnp.tanh(candidate)
    return cell, nn.sigmoid(leave) * jnp.tanh(cell)
