"""The command line of every job: YAML then overrides, nearest names, one-line errors, instant help."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from jobs.cli import parse
from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, RunConfig

ROOT = Path(__file__).resolve().parents[2]
JOBS = sorted(path.stem for path in (ROOT / "jobs").glob("*.py") if path.stem not in ("__init__", "cli"))


def test_yaml_then_overrides_in_order(tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_text("seed: 3\ndata: {places_per_batch: 12, order: mixed}\nvalidate: {sets: [a, b]}\n")
    config = parse(RunConfig, "", ["--config", str(file), "--data.places-per-batch", "8"])
    assert (config.seed, config.data.places_per_batch, config.data.order) == (3, 8, "mixed")
    assert config.validate.sets == ("a", "b")
    assert config.model.backbone.name == "dinov2_vitb14"


def test_every_default_is_reachable_from_yaml(tmp_path: Path) -> None:
    import yaml

    from pipeline.config import to_dict

    file = tmp_path / "all.yaml"
    file.write_text(yaml.safe_dump(to_dict(RunConfig())))
    assert parse(RunConfig, "", ["--config", str(file)]) == RunConfig()


def test_lists_and_switches_may_be_written_plainly() -> None:
    config = parse(EvaluationConfig, "", ["--sets", "a,b:c->d", "--recalls=1,5", "--pca-whiten"])
    assert (config.sets, config.recalls, config.pca_whiten) == (("a", "b:c->d"), (1, 5), True)
    assert parse(EvaluationConfig, "", ["--sets", "[a]", "--pca", "512"]).sets == ("a",)
    assert parse(EvaluationConfig, "", ["--pca-whiten", "false", "--sets", "a"]).pca_whiten is False


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["--data.places_per_bach", "8"], "did you mean 'data.places_per_batch'"),
        (["--lr", "1"], "did you mean 'train.lr'"),
        (["--train.lr", "fast"], "train.lr"),
        (["--data.order", "random"], "data.order must be one of city, mixed, blocked; it is 'random'"),
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_mistakes_are_one_line_with_the_nearest_name(words: list[str], wanted: str) -> None:
    with pytest.raises(UsageError) as error:
        parse(RunConfig, "", words)
    assert wanted in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_key_in_the_file(tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_text("data: {places_per_bath: 3}\n")
    with pytest.raises(UsageError, match=r"did you mean 'data\.places_per_batch'"):
        parse(RunConfig, "", ["--config", str(file)])


@pytest.mark.parametrize("job", JOBS)
def test_help_names_every_field_and_loads_nothing_heavy(job: str) -> None:
    """Half a second on an idle machine; what is asserted is what makes it so: none of the heavy imports."""
    program = (
        f"import sys, runpy\nsys.argv = ['jobs.{job}', '--help']\n"
        f"try:\n    runpy.run_module('jobs.{job}', run_name='__main__', alter_sys=True)\n"
        "except SystemExit as end:\n    assert end.code == 0\n"
        "heavy = {'torch', 'transformers', 'mlflow', 'faiss', 'accelerate', 'matplotlib', 'pyarrow'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    print(f"{job} --help: {time.perf_counter() - start:.2f} s")
    assert "usage:" in done.stdout


def test_user_errors_have_exit_codes_and_no_traceback(tmp_path: Path) -> None:
    for arguments, code in (
        (["jobs.prepare", "--source", str(tmp_path / "none"), "--out", str(tmp_path / "out")], (2, 3)),
        (["jobs.compare", "--output", str(tmp_path), "--experiment", "none"], (2,)),
    ):
        done = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True)
        assert done.returncode in code, done.stderr
        assert "Traceback" not in done.stderr
        assert done.stderr.strip().splitlines()[-1].startswith(arguments[0] + ":")
