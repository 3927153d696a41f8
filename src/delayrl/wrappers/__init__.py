"""Gymnasium wrappers for late observations, actions and rewards, and for noise. They need NumPy and Gymnasium alone."""

from delayrl.wrappers.augmented import AugmentedObservation, AugmentedVectorObservation
from delayrl.wrappers.layers import check_spaces
from delayrl.wrappers.noise import NoisyActions
from delayrl.wrappers.single import Delayed
from delayrl.wrappers.vector import DelayedVector

__all__ = [
    "AugmentedObservation",
    "AugmentedVectorObservation",
    "Delayed",
    "DelayedVector",
    "NoisyActions",
    "check_spaces",
]
