"""Gymnasium wrappers that delay observations, actions and rewards. They need NumPy and Gymnasium alone."""

from delayrl.wrappers.augmented import AugmentedObservation, AugmentedVectorObservation
from delayrl.wrappers.single import Delayed, check_spaces
from delayrl.wrappers.vector import DelayedVector

__all__ = ["AugmentedObservation", "AugmentedVectorObservation", "Delayed", "DelayedVector", "check_spaces"]
