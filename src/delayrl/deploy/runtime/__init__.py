"""What keeps the history of actions right around a policy."""
