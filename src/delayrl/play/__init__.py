"""Trained policies at play: acting, evaluation, pictures and videos."""
