"""Delays inside compiled simulators: the semantics of `delayrl.wrappers` as pure functions on arrays. Needs JAX."""

from delayrl.batched.delay import BatchedDelay as BatchedDelay
from delayrl.batched.delay import as_batched as as_batched
from delayrl.batched.delay import per_episode as per_episode
from delayrl.batched.episodes import Episode as Episode
from delayrl.batched.episodes import act as act
from delayrl.batched.episodes import arrive as arrive
from delayrl.batched.episodes import restart as restart
from delayrl.batched.episodes import start as start
from delayrl.batched.transit import Shown as Shown
from delayrl.batched.transit import augmented as augmented
