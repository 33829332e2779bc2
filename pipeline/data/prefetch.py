"""Fetches remote shards ahead of the training, in the order of the plan.

Invariant: it only makes things earlier. A shard it has not fetched yet is fetched by the worker that needs it, and an
error it meets is raised by the loader.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

from pipeline.common.errors import UserError
from pipeline.data.cache import ShardCache
from pipeline.data.shard_sets import ShardSetsCache


class FetchAhead(threading.Thread):
    """Keeps the shards of the coming batches in the cache, up to half of its bound.

    Args:
        cache: where the shards go.
        shards: names of the shards that each step reads.
        step: the first step that is still to come.
    """

    def __init__(self, cache: ShardCache | ShardSetsCache, shards: Sequence[Sequence[str]], step: int) -> None:
        super().__init__(name="fetch-ahead", daemon=True)
        self.cache, self.shards = cache, shards
        self.error: UserError | None = None
        self._step, self._closed = step, False
        self._moved = threading.Condition()

    def advance(self, step: int) -> None:
        """Says that batches before `step` are consumed. Raises the error that fetching met."""
        if self.error is not None:
            raise self.error
        with self._moved:
            self._step = step
            self._moved.notify()

    def close(self) -> None:
        """Stops after the shard being fetched."""
        with self._moved:
            self._closed = True
            self._moved.notify()

    def run(self) -> None:
        """Follows the cursor until closed or until all is fetched."""
        step = -1
        while True:
            with self._moved:
                while self._step == step and not self._closed:
                    self._moved.wait()
                step = self._step
                if self._closed or step >= len(self.shards):
                    return
            try:
                for name in self._coming(step):
                    if self._closed:
                        return
                    self.cache.fetch(name)
            except UserError as error:
                self.error = error
                return

    def _coming(self, step: int) -> list[str]:
        """The next shards in order of need, at least those of `step`, while they fit in half of the cache."""
        coming: dict[str, None] = {}
        used = 0
        for later in range(step, len(self.shards)):
            new = [name for name in dict.fromkeys(self.shards[later]) if name not in coming]
            used += sum(self.cache.size(name) for name in new)
            if later > step and used > self.cache.limit // 2:
                break
            coming.update(dict.fromkeys(new))
        self.cache.wanted = frozenset(coming)
        return list(coming)
