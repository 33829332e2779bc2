"""How many cores there are for this process: a container or a scheduler may give it fewer than the machine has."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Cores that this process may use; on systems that do not say (macOS, Windows), all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
