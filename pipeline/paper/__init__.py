"""The paper's tables by name: rows, the trainings they need, their evaluation, and the filled table."""
