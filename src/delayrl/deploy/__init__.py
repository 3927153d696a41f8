"""From run to robot. `Controller` needs NumPy alone."""

from delayrl.deploy.controller import ClockError, Controller, OverrunError, Policy
from delayrl.deploy.statistics import Statistics

__all__ = ["ClockError", "Controller", "OverrunError", "Policy", "Statistics"]
