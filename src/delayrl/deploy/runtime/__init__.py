"""The controller around a policy: its clock, the history of actions, and its telemetry."""
