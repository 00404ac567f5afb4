"""How well a hypothesis explains readings: single steps, and filters of noisy ones."""
