"""Imported once by the fork server that decoding workers come from, and by nothing else.

Invariant: importing this makes the server deaf to the signals that a scheduler sends to a whole job; the server ends by
itself when the trainer and all workers have.
"""

from __future__ import annotations

import signal

import pipeline.data.places  # noqa: F401 - with torch, numpy and Pillow: workers are forked with all of it loaded

signal.signal(signal.SIGTERM, signal.SIG_IGN)
signal.signal(signal.SIGUSR1, signal.SIG_IGN)
