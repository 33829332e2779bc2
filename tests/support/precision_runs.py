"""Short real runs of jobs.train on the tiny data, in any precision and number of processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import torch
import yaml
from safetensors.torch import load_file
from tiny import run_settings


def tiny_config(root: Path) -> Path:
    """Three steps of SGD without dropout on shards in `root`: what they compute shows undisguised in the weights."""
    settings = run_settings(root)
    settings["model"]["cross_image"]["dropout"] = 0.0
    settings["train"] |= {"optimizer": "sgd", "lr": 0.2, "schedule": "constant", "steps": 3, "validate_first": False,
                          "save_every": 1, "keep": 9}  # fmt: skip
    settings["validate"]["sets"] = []
    path = root / "tiny.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def launch(config: Path, name: str, processes: int, *options: str, precision: str = "no") -> str:
    """Runs the job through accelerate's launcher; gives what it printed."""
    launcher = [sys.executable, "-m", "accelerate.commands.accelerate_cli", "launch", "--mixed_precision", precision]
    file = "cpu" if processes > 1 else "single"
    command = [*launcher, "--config_file", f"jobs/accelerate/{file}.yaml", "--num_processes", str(processes)]
    if processes > 1:
        from processes import free_port

        command += ["--main_process_port", str(free_port())]
    command += ["-m", "jobs.train", "--config", str(config), "--name", name, *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-3000:]
    return done.stdout + done.stderr


def weights(root: Path, name: str, step: int = 3) -> dict[str, torch.Tensor]:
    """What a run's checkpoint after this step holds."""
    return load_file(root / "outputs" / name / "checkpoints" / f"step-{step:08d}" / "model.safetensors")
