"""The benchmark runs, also where only torch and transformers are installed, and compares equal things."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import torch
from processes import run_ranks

from pipeline.benchmark import data, mining, timing
from pipeline.benchmark.ranks import BothForms
from pipeline.benchmark.sizes import SIZES
from pipeline.data.cliques import CliqueRule
from pipeline.distributed import rank

# not on the GPU machines that only compute; a name whose module is None cannot be imported
ABSENT = ("webdataset", "mlflow", "faiss", "deepspeed", "simplejpeg", "pyarrow", "matplotlib", "sklearn", "accelerate")


def test_the_job_runs_where_only_torch_and_transformers_are() -> None:
    program = (
        f"import sys, runpy\nfor name in {ABSENT}: sys.modules[name] = None\n"
        "for words in (['data', '--size', 'tiny'], ['step', '--size', 'tiny', '--device', 'cpu']):\n"
        "    sys.argv = ['jobs.benchmark', *words]\n"
        "    try:\n"
        "        runpy.run_module('jobs.benchmark', run_name='__main__', alter_sys=True)\n"
        "    except SystemExit as end:\n"
        "        print('ended with', end.code, file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=240)
    assert re.findall("ended with (.*)", done.stderr) == ["2", "0"], done.stderr[-3000:]
    assert "data needs pyarrow, which is not installed here" in done.stderr
    lines = done.stdout.splitlines()
    assert "no GPU" in lines[0] and f"torch {torch.__version__}" in lines[0]
    for wanted in ("bf16 autocast", "forward: ", "2 at a time, in step", "inference, 8 images"):
        assert any(wanted in line for line in lines), done.stdout


def test_both_forms_give_the_same_loss_and_gradient() -> None:
    """On two ranks; the same check runs in every benchmark before the clock starts."""

    def both() -> tuple[dict[str, list[float]], bool]:
        forms = BothForms(SIZES["tiny"], 16, torch.device("cpu"))
        seconds = forms.seconds(2)
        if rank() == 0:  # the check must be able to fail
            forms.regions.data *= 2
        different = not torch.allclose(forms.gradient("own_rows")[1], forms.gradient("redundant")[1] * 2)
        return seconds, different

    for seconds, different in run_ranks(both, 2):
        assert different and all(len(times) == 2 and min(times) > 0 for times in seconds.values())


def test_reading_is_compared_on_real_shards(tmp_path: Path) -> None:
    comparisons = data.measure(1, 8, 28, workers=(0,))
    names = [row.name for comparison in comparisons for row in comparison.rows]
    assert "shards, by offset" in names and "0 workers" in names
    assert all(row.per_second > 0 for comparison in comparisons for row in comparison.rows)
    files, index = data.prepare(tmp_path, 2)
    from pipeline.config import DataConfig
    from pipeline.data.cache import ShardCache
    from pipeline.data.places import Places, members

    dataset = Places(members(index, [0, 1]), ShardCache(index, tmp_path, 1), DataConfig(), 0, 0)  # type: ignore[arg-type]
    found = sorted(image for position in range(2) for image in dataset.encoded(position))
    assert found == sorted(path.read_bytes() for path in files)  # both ways read the same bytes


def test_ratios_are_taken_within_a_round() -> None:
    """A machine that slows down threefold in the second round changes the times and not the ratio."""
    comparison = timing.from_seconds("t", {"a": [1.0, 3.0], "b": [0.5, 1.5]}, items=6)
    assert comparison.rows[1].ratios == (2.0, 2.0) and comparison.ratio("b") == 2.0
    assert comparison.rows[0].per_second == 3.0
    calls: list[str] = []
    ways = {name: (lambda name=name: calls.append(name)) for name in "abc"}
    timing.compare("t", ways, 1, 2, torch.device("cpu"))  # type: ignore[arg-type]
    assert "".join(calls) == "abc" + "abc" + "cba"
    shown = timing.show([comparison])
    assert "2.00 (2.00-2.00)" in shown


def test_planning_mined_batches_is_measured(tmp_path: Path) -> None:
    """On made places, and on those of a table with four images; the groups are alike, and none is near."""
    rule = CliqueRule(3, 16, 25.0, 0.05)
    lines = list(mining.measure(None, 460, 16, 12, rule, 25.0, 0))
    assert lines[0].startswith("460 places in 23 cities") and "plan: 38 batches" in lines[2]
    mined, city = (float(line.rsplit(" ", 1)[1]) for line in lines[-2:])
    assert mined > 2 * city
    rows = ["place_id,lat,lon", *(f"{place},{place},2" for place in range(30) for _ in range(4)), "99,1,1"]
    (tmp_path / "Oslo.csv").write_text("\n".join(rows) + "\n")
    assert next(mining.measure(str(tmp_path), 0, 16, 12, rule, 25.0, 0)).startswith("30 places in 1 cities")
