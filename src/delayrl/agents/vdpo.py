"""Variational Delayed Policy Optimization (Wu et al., NeurIPS 2024), Algorithm 1.

Idea: (A) learn a reference policy with SAC where there is no delay; (B) clone it into a delayed policy: a transformer
on (last observation, actions since) whose belief head reconstructs the unseen states, and whose policy head is brought
near the reference by KL. Position i of the transformer serves the delay i + 1, so one network serves every age 1..Δ;
at age 0 the state is current and the reference itself acts.

Views: the reference sees s_t, the delayed policy x_t. While it trains, its behaviour reads s_t (privileged), unless
`behaviour="delayed"`.

Deviations from the paper and from the released code are numbered in docs/algorithms/vdpo.md.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase, descend
from delayrl.core import networks
from delayrl.core.networks import Gaussian, Params
from delayrl.core.objectives import gaussian_kl, masked_mean
from delayrl.core.transformer import transformer, transformer_init
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import view
from delayrl.errors import DelayRLError

Representation = Literal["transformer", "transformer-no-belief", "mlp"]
Behaviour = Literal["lower-q", "delayed", "reference", "mixture"]
Direction = Literal["reverse", "forward"]


class State(NamedTuple):
    """The reference, and the delayed policy's parts: encoder, belief decoder, policy head."""

    reference: sac.State
    encoder: Params
    decoder: Params
    head: Params
    belief_opt_state: optax.OptState
    clone_opt_state: optax.OptState


class Unseen(NamedTuple):
    """What is cloned from: x_{t+1}, and the states that it hides."""

    obs: Float[Array, "batch obs"]
    actions: Float[Array, "batch delay action"]
    states: Float[Array, "batch delay obs"]
    mask: Bool[Array, "batch delay"]


@dataclass(frozen=True)
class VDPO:
    """Hyperparameters; the defaults are the paper's (appendix) and, where it is silent, the released code's."""

    reference: sac.SAC = field(default_factory=sac.SAC)
    representation: Annotated[Representation, "of x_t; the paper's ablation"] = "transformer"
    width: Annotated[int, "embedding dimension of the transformer, and width of the policy head"] = 256
    layers: Annotated[int, "blocks of the transformer"] = 3
    dropout: Annotated[float, "rate in embedding, attention and residuals", (0.0, 0.99)] = 0.1
    learning_rate: Annotated[float, "Adam's step size for the delayed policy", (0.0, 1.0)] = 3e-4
    clone_every: Annotated[int, "environment steps between two rounds of cloning"] = 1000
    clone_updates: Annotated[int, "KL updates in a round, each on a fresh batch"] = 1000
    direction: Annotated[Direction, "KL(delayed‖reference), or forward: KL(reference‖delayed)"] = "reverse"
    behaviour: Annotated[Behaviour, "who acts in training: the sample with the lower Q, or what is named"] = "lower-q"

    @property
    def privileged(self) -> bool:
        """The reference needs the true state to act."""
        return self.behaviour != "delayed"

    def ahead(self, spec: Spec) -> int:
        """The reference's targets; cloning needs one step."""
        return self.reference.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Reference and belief at every step; now and then many KL updates."""
        learn, *_ = self.reference.phases()
        clone = Phase(self.clone_every, self.clone_updates, self.reference.batch_size, self.clone)
        return learn._replace(update=self.update), clone

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """The delay-free SAC that is cloned."""
        return self.reference, state.reference

    def init(self, spec: Spec, key: Key) -> State:
        """Fresh networks; Δ is the transformer's length."""
        if spec.delay < 1:
            raise DelayRLError("vdpo learns a policy for a delay of at least 1 step: give --delay N, or train sac")
        reference_key, encoder_key, decoder_key, head_key = jax.random.split(key, 4)
        encoder: Params = {}
        features = spec.obs_size + spec.delay * spec.action_size + 1
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
        """The delayed policy at the shown age; in training, who acts is what `behaviour` says."""
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
        if self.behaviour == "delayed":
            return delayed
        truth = seen.truth
        assert truth is not None, "behaviour with the reference is privileged"
        reference, _ = networks.sample(self.reference.policy(state.reference.actor, truth), reference_key)
        if self.behaviour == "reference":
            return reference
        if self.behaviour == "mixture":
            return jnp.where(jax.random.bernoulli(coin_key), reference, delayed)
        return networks.lower_q(state.reference.critic, truth, reference, delayed)

    def deterministic(self, state: State) -> Deterministic:
        """Encoder and policy head; at age 0 the reference."""
        return Deterministic("augmented", state.head, state.encoder or None, state.reference.actor)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """(A) SAC's update of the reference; and of encoder and belief decoder (eq. 10), on the same batch."""
        sac_key, dropout_key = jax.random.split(key)
        reference, metrics = self.reference.update(state.reference, windows, sac_key, count)
        state = state._replace(reference=reference)
        if self.representation != "transformer":
            return state, metrics
        adam, params = optax.adam(self.learning_rate), (state.encoder, state.decoder)
        batch = unseen(windows), dropout_key
        (encoder, decoder), opt_state, loss, _ = descend(adam, self.belief_loss, params, state.belief_opt_state, *batch)
        state = state._replace(encoder=encoder, decoder=decoder, belief_opt_state=opt_state)
        return state, metrics | {"belief_loss": loss}

    def clone(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """(B) One KL update of the policy head towards the reference (eq. 11); the encoder stays where it is."""
        adam, params = optax.adam(self.learning_rate), self._cloned(state.encoder, state.head)
        batch = state, unseen(windows), key
        cloned, opt_state, loss, _ = descend(adam, self.clone_loss, params, state.clone_opt_state, *batch)
        return state._replace(**cloned, clone_opt_state=opt_state), {"kl": loss}

    def policy(self, state: State, obs: Array, actions: Array, key: Key | None = None) -> Gaussian:
        """The delayed policy for every age 1..Δ: [..., Δ, A]."""
        return self.reference.policy(state.head, self.encode(state.encoder, obs, actions, key))

    def encode(
        self, encoder: Params, obs: Array, actions: Array, key: Key | None
    ) -> Float[Array, "*batch delay width"]:
        """What the heads read at each age. `mlp`: the augmented state of that age itself."""
        if self.representation != "mlp":
            return transformer(encoder, obs, actions, self.dropout, key)
        *batch, delay, size = actions.shape
        until = jnp.where(jnp.tril(jnp.ones((delay, delay), bool))[..., None], actions[..., None, :, :], 0)
        ages = jnp.broadcast_to(jnp.arange(1, delay + 1)[:, None] / delay, (*batch, delay, 1))
        repeated = jnp.broadcast_to(obs[..., None, :], (*batch, delay, obs.shape[-1]))
        return jnp.concatenate([repeated, until.reshape(*batch, delay, delay * size), ages], -1)

    def belief_loss(self, params: tuple[Params, Params], x: Unseen, key: Key) -> tuple[Array, None]:
        """Mean squared error of the reconstructed states (eq. 10)."""
        encoder, decoder = params
        states = networks.linear(decoder, self.encode(encoder, x.obs, x.actions, key))
        return masked_mean(((states - x.states) ** 2).mean(-1), x.mask), None

    def clone_loss(self, cloned: Params, state: State, x: Unseen, key: Key) -> tuple[Array, None]:
        """KL between the delayed policy at each age and the reference at the state that it cannot see (eq. 11)."""
        delayed = self.policy(state._replace(**cloned), x.obs, x.actions, key)
        reference = self.reference.policy(state.reference.actor, x.states)
        pair = (delayed, reference) if self.direction == "reverse" else (reference, delayed)
        return masked_mean(gaussian_kl(*pair).mean(-1), x.mask), None

    def _cloned(self, encoder: Params, head: Params) -> Params:
        """What cloning trains: the head; without a belief loss the encoder too."""
        return {"head": head, "encoder": encoder} if self.representation == "transformer-no-belief" else {"head": head}


def unseen(windows: Window) -> Unseen:
    """x_{t+1} with all the Δ steps that it hides (fewer at the start of an episode), for each window."""

    def of_window(window: Window) -> Unseen:
        now = window.delay + 1
        age = window.valid[1:now].sum()
        x = view(window, 1, age=age)
        slots = jnp.arange(window.delay)
        return Unseen(x.obs, x.actions, window.obs[jnp.minimum(now - age + 1 + slots, now)], slots < age)

    return jax.vmap(of_window)(windows)
