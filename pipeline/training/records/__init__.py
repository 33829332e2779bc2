"""What a run leaves for people: its folder and status, its log, the progress line, MLflow, and runs side by side."""
