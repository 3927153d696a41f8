"""Any-age: BPQL whose actor acts on a forecast of the current state, one network for every age.

Idea: BPQL's critic values actions in the true state s_t, whatever view chose them. A forecast of s_t from x_t learns
from the states alone, and the policy acts on it. For one and the same s_t the replay holds the view of every age:
x^(j)_t = (s_{t-j}, a_{t-j}, …, a_{t-1}), j = 0..Δ. So half of each batch is seen at a second age, and the same critic
teaches all of them. π(x^(d)_t) may be pulled towards a younger π(x^(j)_t), with a weight that is annealed to nothing.

Views: the actor sees a forecast from x_t, at its own and at a second age; the critics see s_t. Unprivileged: s_t and
the observations in between are learned from once they have arrived.

Its skeleton is `pred_detach` of Wang et al., ICLR 2024; docs/algorithms/any-age.md says what it takes from whom.
"""

import functools
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Deterministic, Phase, Schedule
from delayrl.agents.lifting import lifting_loss
from delayrl.agents.sac import State
from delayrl.core import networks
from delayrl.core.forecast import Error, follow_changes, forecast_init, forecast_loss, forecasting, held, in_task_units
from delayrl.core.networks import Gaussian, Params
from delayrl.core.objectives import annealed, gaussian_kl, masked_mean
from delayrl.core.sequence import sequence, sequence_init, tokens
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import network_input, view
from delayrl.errors import DelayRLError

SecondAge = Literal["none", "random", "any", "zero"]
Pull = Literal["moments", "kl"]
Encoder = Literal["mlp", "forecast", "transformer"]
LearnsFrom = Literal["states", "states+values"]


@dataclass(frozen=True)
class AnyAge:
    """The any-age agent."""

    bpql: sac.SAC = field(
        default_factory=lambda: sac.SAC(actor_sees="augmented", entropy_unit="scaled", critic_norm="layer")
    )
    second_age: Annotated[SecondAge, "the age that the actor learns at too: random in 0..d, any in 0..Δ, or 0"] = (
        "random"
    )
    pull: Annotated[Pull, "distance of the pull: of both policies' moments, or KL(older‖younger)"] = "moments"
    pull_weight: Annotated[float, "initial weight of a pull towards the younger age; 0: none", (0.0, 1e6)] = 0.0
    pull_hold: Annotated[float, "part of the run in which the pull's weight stays constant", (0.0, 1.0)] = 0.25
    pull_end: Annotated[float, "part of the run after which the pull's weight is 0", (0.0, 1.0)] = 0.75
    encoder: Annotated[Encoder, "how the actor reads x_t: flat, by a forecast of s_t, or as a sequence"] = "forecast"
    forecast_learns_from: Annotated[LearnsFrom, "what moves the forecast: states, or also values of actions"] = "states"
    forecast_error: Annotated[Error, "what the forecast minimises: a sample's squared error, or its root"] = "squared"
    encoder_width: Annotated[int, "embedding dimension of the transformer"] = 64
    encoder_layers: Annotated[int, "transformer blocks"] = 2
    belief_weight: Annotated[float, "weight of the transformer's loss for the unseen states", (0.0, 1e6)] = 0.0
    run_steps: Annotated[int, "fixed"] = 0  # environment steps of the run, from its schedule

    privileged = False

    @property
    def every_age(self) -> bool:
        """Whether the second age is any up to that of the sample."""
        return self.second_age in ("random", "any")

    def ahead(self, spec: Spec) -> int:
        """Return the longest k of the k-step targets."""
        return self.bpql.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Return one phase, the update."""
        return (self.bpql.phases()[0]._replace(update=self.update),)

    def for_run(self, schedule: Schedule) -> "AnyAge":
        """Return the agent with the length of its run. Raises DelayRLError for options that contradict each other."""
        if self.pull_hold > self.pull_end:
            raise DelayRLError(f"pull_hold must be no later than pull_end, {self.pull_end}; got {self.pull_hold}")
        if self.pull_weight and self.second_age in ("none", "any"):
            raise DelayRLError("pull_weight needs a younger second_age to pull towards, random or zero; else give 0")
        if self.belief_weight and (self.encoder != "transformer" or self.second_age == "none"):
            raise DelayRLError("belief_weight needs encoder=transformer and a second_age; without them give 0")
        if (self.forecast_learns_from, self.forecast_error) != ("states", "squared") and self.encoder != "forecast":
            options = "forecast_learns_from=states+values and forecast_error=distance"
            raise DelayRLError(f"{options} need encoder=forecast; got {self.encoder}")
        return replace(self, run_steps=schedule.steps)

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise as BPQL, but for the actor of another encoder; without a delay there is nothing to encode."""
        state = self.bpql.init(spec, key)
        if self.encoder == "mlp" or spec.delay == 0:
            return state
        actor_key = jax.random.split(jax.random.fold_in(key, 1))[0]  # also a key of BPQL's critics
        if self.encoder == "forecast":
            actor = forecast_init(actor_key, spec, self.bpql.hidden, 2 * spec.action_size)
        else:
            sizes = self.encoder_width, self.encoder_layers, self.bpql.hidden, 2 * spec.action_size
            actor = sequence_init(actor_key, spec, *sizes)
        if self.belief_weight:
            belief_key = jax.random.fold_in(key, 2)
            actor["belief"] = networks.linear_init(belief_key, self.encoder_width, spec.obs_size)
        return state._replace(actor=actor, actor_opt_state=optax.adam(self.bpql.actor_learning_rate).init(actor))

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Sample the policy at the shown age, or return its mode."""
        return self.learner.act(state, seen, key, explore=explore)

    def deterministic(self, state: State) -> Deterministic:
        """Return the actor."""
        if "forecast" in state.actor:
            return Deterministic("augmented", state.actor["policy"], forecast=in_task_units(state.actor))
        if isinstance(state.actor, dict):
            return Deterministic("augmented", state.actor["head"], state.actor["encoder"], state.actor["current"])
        return self.bpql.deterministic(state)

    @property
    def learner(self) -> sac.SAC:
        """BPQL with an actor of any encoder."""
        return replace(self.bpql, actor_network=encoded if self.forecast_learns_from == "states" else encoded_as_one)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update the critics as BPQL does, and the actor at its own and a second age."""
        if (self.second_age == "none" and self.encoder != "forecast") or windows.delay == 0:
            return self.learner.update(state, windows, key, count)
        age_key, update_key = jax.random.split(key)
        weight = self.weight(self.phases()[0].step_of(count))
        second = None if self.second_age == "none" else self.second_view(windows, age_key)
        improve = functools.partial(self.improve_actor, windows, second, weight)
        state, metrics = self.learner.update(state, windows, update_key, count, improve)
        return state, metrics | ({"pull_weight": weight} if self.pull_weight else {})

    def second_view(self, windows: Window, key: Key) -> Float[Array, "batch input"]:
        """Return x^(j)_t of each window as the actor sees it: j uniform on 0..d or 0..Δ in its episode, or 0."""
        now = windows.delay
        oldest = windows.valid[:, :now].sum(1) if self.second_age == "any" else windows.age[:, now]
        share = jnp.zeros(oldest.shape) if self.second_age == "zero" else jax.random.uniform(key, oldest.shape)
        ages = jnp.floor(share * (oldest + 1)).astype(jnp.int32)
        return jax.vmap(lambda window, age: network_input(view(window, age=age), "augmented"))(windows, ages)

    def improve_actor(
        self,
        windows: Window,
        second: Array | None,
        weight: Array,
        state: State,
        actor_input: Array,
        critic_input: Array,
        key: Key,
    ) -> State:
        """Take one gradient step on the actor: as much for each age, the pull of the older one, its encoder's loss."""
        x = self.views(actor_input, second)
        states = jnp.stack([critic_input] * len(x))

        def penalty(actor: Params, policy: Gaussian) -> Array:
            total = jnp.zeros(())
            if self.pull_weight and second is not None:
                total += weight * self.distance(*(Gaussian(policy.mean[i], policy.log_std[i]) for i in range(2)))
            if self.encoder == "forecast":
                total += forecast_loss(actor, x, states, self.forecast_error)
            if self.belief_weight:
                total += self.belief_weight * belief_loss(actor, actor_input, windows)
            return total

        state = self.learner.improve_actor(state, x, states, key, penalty)
        if self.encoder == "forecast":
            state = state._replace(actor=follow_changes(state.actor, x, states))
        return state

    def views(self, own: Float[Array, "batch input"], second: Array | None) -> Float[Array, "ages batch input"]:
        """Return what the actor learns at: own and second ages in turn, or with a pull each sample at both."""
        if second is None:
            return own[None]
        if self.pull_weight:
            return jnp.stack([own, second])
        return jnp.where(jnp.arange(len(own))[:, None] % 2 == 0, own, second)[None]

    def distance(self, older: Gaussian, younger: Gaussian) -> Float[Array, ""]:
        """Return how far the older policy is from the younger one, which is held fixed."""
        if self.pull == "moments":
            return lifting_loss(older, younger)
        return gaussian_kl(older, jax.lax.stop_gradient(younger)).sum(-1).mean()

    def weight(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Return w(t), which is constant at first, then falls linearly to 0 and stays there."""
        return self.pull_weight * annealed(step, self.pull_hold * self.run_steps, self.pull_end * self.run_steps)


def encoded(actor: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch outputs"]:
    """Apply an actor of any encoder, whose forecast no value moves."""
    return encoded_as_one(held(actor) if "forecast" in actor else actor, x)


def encoded_as_one(actor: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch outputs"]:
    """Apply an actor of any encoder; without a delay it is an `mlp`, which is a list."""
    if isinstance(actor, list):
        return networks.mlp(actor, x)
    return forecasting(actor, x) if "forecast" in actor else sequence(actor, x)


def belief_loss(actor: Params, x: Float[Array, "batch input"], windows: Window) -> Float[Array, ""]:
    """Return the mean squared error of the states that x_t hides, as differences from s_{t-d} in their own deviations.

    Token i predicts the state i + 1 steps after s_{t-d}; the deviation of each dimension is the batch's.
    """
    now, slots = windows.delay, jnp.arange(windows.delay)
    age = windows.age[:, now]
    hidden = slots < age[:, None]
    rows = jnp.minimum((now - age)[:, None] + slots + 1, now)
    states = jnp.take_along_axis(windows.obs, rows[..., None], 1)
    seen = jnp.take_along_axis(windows.obs, (now - age)[:, None, None], 1)
    change = jnp.where(hidden[..., None], states - seen, 0)
    deviation = jnp.sqrt((change**2).sum((0, 1)) / jnp.maximum(hidden.sum(), 1) + 1e-8)
    errors = networks.linear(actor["belief"], tokens(actor, x)) - change / deviation
    return masked_mean((errors**2).mean(-1), hidden)
