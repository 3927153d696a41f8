"""Variational Delayed Policy Optimization (Wu et al., NeurIPS 2024), Algorithm 1.

Idea: (A) learn a reference policy by SAC without delay; (B) clone it into a delayed policy, a transformer on (last
observation, actions since) whose belief head reconstructs the unseen states and whose policy head is trained towards
the reference by KL. Position i, counted from 0, serves the age i + 1, so one network serves all ages 1..Δ; at age 0
the reference acts.

Views: the reference sees s_t, the delayed policy x_t. Privileged in training (reads s_t) unless `behaviour="delayed"`.

Deviations from the paper and from the released code are numbered in docs/algorithms/vdpo.md.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase, descend
from delayrl.agents.critics import lower_q
from delayrl.core import networks
from delayrl.core.networks import Gaussian, Params
from delayrl.core.objectives import gaussian_kl, masked_mean
from delayrl.core.transformer import transformer, transformer_init
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import input_size, view
from delayrl.errors import DelayRLError

Representation = Literal["transformer", "transformer-no-belief", "mlp"]
Behaviour = Literal["lower-q", "delayed", "reference", "mixture"]
Direction = Literal["reverse", "forward"]
Current = Literal["reference", "random"]


class State(NamedTuple):
    """The reference, and the parts of the delayed policy: encoder, belief decoder and policy head."""

    reference: sac.State
    encoder: Params
    decoder: Params
    head: Params
    belief_opt_state: optax.OptState
    clone_opt_state: optax.OptState


class Unseen(NamedTuple):
    """A batch for belief and cloning: x_{t+1} and the states that it hides."""

    obs: Float[Array, "batch obs"]
    actions: Float[Array, "batch delay action"]
    states: Float[Array, "batch delay obs"]
    mask: Bool[Array, "batch delay"]


@dataclass(frozen=True)
class VDPO:
    """The VDPO agent. Its hyperparameters default to the paper's (appendix), or else to the released code's."""

    reference: sac.SAC = field(default_factory=sac.SAC)
    representation: Annotated[Representation, "encoder of x_t; the others are the paper's ablation"] = "transformer"
    width: Annotated[int, "embedding dimension of the transformer and width of the policy head"] = 256
    layers: Annotated[int, "transformer blocks"] = 3
    dropout: Annotated[float, "dropout rate of embedding, attention and residuals", (0.0, 0.99)] = 0.1
    learning_rate: Annotated[float, "Adam's step size for the delayed policy", (0.0, 1.0)] = 3e-4
    clone_every: Annotated[int, "environment steps between rounds of cloning"] = 1000
    clone_updates: Annotated[int, "KL updates per round, each on a fresh batch"] = 1000
    direction: Annotated[Direction, "reverse: KL(delayed‖reference); forward: KL(reference‖delayed)"] = "reverse"
    behaviour: Annotated[
        Behaviour,
        "who acts in training: delayed, reference, mixture (a coin flip), or lower-q (the one with the lower Q)",
    ] = "lower-q"
    tokens: Annotated[
        int, "most hidden states in an update of belief or cloning; 0: those of a whole batch", (0, math.inf)
    ] = 0
    at_age_0: Annotated[Current, "the delayed policy's action in training where nothing is hidden"] = "reference"

    every_age = True

    @property
    def privileged(self) -> bool:
        """Whether the reference may act in training. It needs the true state."""
        return self.behaviour != "delayed"

    def ahead(self, spec: Spec) -> int:
        """Return the longest k of the reference's targets; cloning needs one step."""
        return self.reference.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Return two phases: reference and belief learn at every step, cloning runs in rounds of many KL updates."""
        learn, *_ = self.reference.phases()
        clone = Phase(self.clone_every, self.clone_updates, self.reference.batch_size, self.clone)
        return learn._replace(update=self.update), clone

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """Return the delay-free SAC that is cloned."""
        return self.reference, state.reference

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise the networks. The transformer's length is Δ."""
        if spec.delay < 1:
            raise DelayRLError("vdpo learns a policy for a delay of at least 1 step: give --delay N, or train sac")
        reference_key, encoder_key, decoder_key, head_key = jax.random.split(key, 4)
        encoder: Params = {}
        features = input_size(spec, "augmented")
        if self.representation != "mlp":
            sizes = (spec.obs_size, spec.action_size, spec.delay, self.width, self.layers)
            encoder, features = transformer_init(encoder_key, *sizes), self.width
        decoder = networks.linear_init(decoder_key, features, spec.obs_size, 0.02)
        head = networks.mlp_init(head_key, (features, self.width, self.width, 2 * spec.action_size), 0.02)
        adam = optax.adam(self.learning_rate)
        return State(
            self.reference.init(replace(spec, delay=0), reference_key),
            encoder,
            decoder,
            head,
            adam.init((encoder, decoder)),
            adam.init(self._cloned(encoder, head)),
        )

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Return the delayed policy's action at the shown age; in training, `behaviour` decides which policy acts."""
        dropout_key, delayed_key, reference_key, coin_key = jax.random.split(key, 4)
        every_age = self.policy(state, seen.obs, seen.actions, dropout_key if explore else None)
        current = self.reference.policy(state.reference.actor, seen.obs)
        row = jnp.maximum(seen.age - 1, 0)  # row i serves the age i + 1; at age 0 the reference acts
        policy = Gaussian(
            jnp.where(seen.age > 0, every_age.mean[row], current.mean),
            jnp.where(seen.age > 0, every_age.log_std[row], current.log_std),
        )
        if not explore:
            return networks.mode(policy)
        delayed, _ = networks.sample(policy, delayed_key)
        if self.at_age_0 == "random":
            anything = networks.uniform(jax.random.fold_in(delayed_key, 1), delayed.shape)
            delayed = jnp.where(seen.age > 0, delayed, anything)
        if self.behaviour == "delayed":
            return delayed
        truth = seen.truth
        assert truth is not None, "behaviour with the reference is privileged"
        reference, _ = networks.sample(self.reference.policy(state.reference.actor, truth), reference_key)
        if self.behaviour == "reference":
            return reference
        if self.behaviour == "mixture":
            return jnp.where(jax.random.bernoulli(coin_key), reference, delayed)
        return lower_q(state.reference.critic, state.reference.target, truth, reference, delayed)

    def deterministic(self, state: State) -> Deterministic:
        """Return encoder and policy head, and the reference for age 0."""
        return Deterministic("augmented", state.head, state.encoder or None, state.reference.actor)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update the reference by SAC (A), and encoder and belief decoder (eq. 10), on the same batch."""
        sac_key, dropout_key = jax.random.split(key)
        reference, metrics = self.reference.update(state.reference, windows, sac_key, count)
        state = state._replace(reference=reference)
        if self.representation != "transformer":
            return state, metrics
        adam, params = optax.adam(self.learning_rate), (state.encoder, state.decoder)
        batch = unseen(self._some(windows)), dropout_key
        (encoder, decoder), opt_state, loss, _ = descend(adam, self.belief_loss, params, state.belief_opt_state, *batch)
        state = state._replace(encoder=encoder, decoder=decoder, belief_opt_state=opt_state)
        return state, metrics | {"belief_loss": loss}

    def clone(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Take one KL step of the delayed policy towards the reference (B, eq. 11), on the networks in `_cloned`."""
        adam, params = optax.adam(self.learning_rate), self._cloned(state.encoder, state.head)
        batch = state, unseen(self._some(windows)), key
        cloned, opt_state, loss, _ = descend(adam, self.clone_loss, params, state.clone_opt_state, *batch)
        return state._replace(**cloned, clone_opt_state=opt_state), {"kl": loss}

    def policy(self, state: State, obs: Array, actions: Array, key: Key | None = None) -> Gaussian:
        """Return the delayed policy for every age 1..Δ: [..., Δ, A]."""
        return self.reference.policy(state.head, self.encode(state.encoder, obs, actions, key))

    def encode(
        self, encoder: Params, obs: Array, actions: Array, key: Key | None
    ) -> Float[Array, "*batch delay width"]:
        """Return the input of the heads at each age; for `mlp`, the augmented state of that age."""
        if self.representation != "mlp":
            return transformer(encoder, obs, actions, self.dropout, key)
        *batch, delay, size = actions.shape
        until = jnp.where(jnp.tril(jnp.ones((delay, delay), bool))[..., None], actions[..., None, :, :], 0)
        ages = jnp.broadcast_to(jnp.arange(1, delay + 1)[:, None] / delay, (*batch, delay, 1))
        repeated = jnp.broadcast_to(obs[..., None, :], (*batch, delay, obs.shape[-1]))
        return jnp.concatenate([repeated, until.reshape(*batch, delay, delay * size), ages], -1)

    def belief_loss(self, params: tuple[Params, Params], x: Unseen, key: Key) -> tuple[Array, None]:
        """Return the mean squared error of the reconstructed states (eq. 10)."""
        encoder, decoder = params
        states = networks.linear(decoder, self.encode(encoder, x.obs, x.actions, key))
        return masked_mean(((states - x.states) ** 2).mean(-1), x.mask), None

    def clone_loss(self, cloned: Params, state: State, x: Unseen, key: Key) -> tuple[Array, None]:
        """Return the KL between the delayed policy at each age and the reference at the hidden state (eq. 11)."""
        delayed = self.policy(state._replace(**cloned), x.obs, x.actions, key)
        reference = self.reference.policy(state.reference.actor, x.states)
        pair = (delayed, reference) if self.direction == "reverse" else (reference, delayed)
        return masked_mean(gaussian_kl(*pair).mean(-1), x.mask), None

    def _some(self, windows: Window) -> Window:
        """Return the windows that belief and cloning learn from: each brings Δ tokens, which is what they cost."""
        if not self.tokens:
            return windows
        number = -(-self.tokens // windows.delay)
        return jax.tree.map(lambda x: x[:number], windows)

    def _cloned(self, encoder: Params, head: Params) -> Params:
        """Return the networks that cloning trains: the head, and without a belief loss the transformer too."""
        return {"head": head, "encoder": encoder} if self.representation == "transformer-no-belief" else {"head": head}


def unseen(windows: Window) -> Unseen:
    """Return x_{t+1} and the Δ states that it hides (fewer at the start of an episode), for each window."""

    def of_window(window: Window) -> Unseen:
        now = window.delay + 1
        age = window.valid[1:now].sum()
        x = view(window, 1, age=age)
        slots = jnp.arange(window.delay)
        return Unseen(x.obs, x.actions, window.obs[jnp.minimum(now - age + 1 + slots, now)], slots < age)

    return jax.vmap(of_window)(windows)
