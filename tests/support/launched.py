"""A job on W ranks without a launcher: forked processes with the variables that launchers and slurm scripts set."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

from job_process import JobProcess
from processes import free_port

# what `accelerate launch` puts into the environment for jobs/accelerate/<engine>.yaml
ENGINES: dict[str, dict[str, str]] = {
    "ddp": {},
    "fsdp2": {"ACCELERATE_USE_FSDP": "true", "FSDP_VERSION": "2"},
    **{
        f"zero{stage}": {"ACCELERATE_USE_DEEPSPEED": "true", "ACCELERATE_DEEPSPEED_ZERO_STAGE": str(stage)}
        for stage in (1, 2, 3)
    },
}


class Launched:
    """`MODULE ARGUMENTS` on `world` ranks under an engine; outputs in `<output>.<rank>`."""

    def __init__(self, engine: str, world: int, module: str, arguments: list[str], output: Path) -> None:
        port = str(free_port())
        common = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "ACCELERATE_MIXED_PRECISION": "no"}
        self.ranks = []
        for r in range(world):
            ranked = {"RANK": str(r), "LOCAL_RANK": str(r), "WORLD_SIZE": str(world), "LOCAL_WORLD_SIZE": str(world)}
            environment = {**common, **ENGINES[engine], **(ranked if world > 1 else {})}
            log = output.with_name(f"{output.name}.{r}")
            log.unlink(missing_ok=True)
            self.ranks.append(JobProcess(module, arguments, log, environment))

    def wait(self, timeout: float = 200.0) -> list[int]:
        """Exit codes by rank."""
        return [process.wait(timeout) for process in self.ranks]

    def done(self, timeout: float = 200.0) -> str:
        """Waits for a success of all ranks; what rank 0 printed."""
        codes = self.wait(timeout)
        assert codes == [0] * len(codes), (codes, "\n".join(p.text()[-2500:] for p in self.ranks))
        return self.ranks[0].text()

    def kill(self) -> None:
        """SIGKILL to all ranks, as a machine that goes dark."""
        for process in self.ranks:
            if process.alive():
                process.send(signal.SIGKILL)
        self.wait()

    def kill_when(self, ready: Callable[[], bool], timeout: float = 200.0) -> None:
        """SIGKILL to all ranks as soon as `ready()` is true."""
        deadline = time.monotonic() + timeout
        while not ready():
            assert all(p.alive() for p in self.ranks), "\n".join(p.text()[-2500:] for p in self.ranks)
            assert time.monotonic() < deadline, self.ranks[0].text()[-2500:]
            time.sleep(0.002)
        self.kill()
