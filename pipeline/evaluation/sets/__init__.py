"""Evaluation sets: their names, their layouts on disk, and which database images are correct."""
