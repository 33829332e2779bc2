"""The command line of every job: YAML then overrides, nearest names, one-line errors, instant help."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
import time
import tomllib
import types
from pathlib import Path

import pytest

from jobs import evaluate
from jobs.cli import parse
from jobs.evaluate import EvaluateJob
from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, RunConfig

ROOT = Path(__file__).resolve().parents[2]
JOBS = sorted(
    path.stem
    for path in (ROOT / "jobs").glob("*.py")
    if path.stem not in ("__init__", "__main__", "cli", "console", "processes", "there")
)


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
        (["--data.order", "random"], "data.order must be one of city, mixed, blocked, mined; it is 'random'"),
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


def test_help_has_groups_examples_as_lines_and_no_types_of_python(capsys: pytest.CaptureFixture[str]) -> None:
    """The job's own options first, then the inherited, then the sections; both spellings are read."""
    with pytest.raises(SystemExit):
        parse(EvaluateJob, evaluate.__doc__ or "", ["--help"])
    told = capsys.readouterr().out
    assert "\n    python -m jobs.evaluate --checkpoint outputs/RUN --sets" in told
    order = [
        told.index(word) for word in ("options:", "--checkpoint TEXT", "Which sets are evaluated", "--sets TEXT,...")
    ]
    assert order == sorted(order)
    assert "--split {train,val,test}" in told and "(default: test)" in told
    assert not any(word in told for word in ("Literal", "Union", "None", "==SUPPRESS", "Optional"))
    with pytest.raises(SystemExit):
        parse(RunConfig, "", ["--help"])
    told = capsys.readouterr().out
    assert (
        told.index("--name TEXT") < told.index("\ndata: ") < told.index("--data.order {city,") < told.index("\nmodel: ")
    )
    assert parse(EvaluationConfig, "", ["--group-size", "8"]) == parse(EvaluationConfig, "", ["--group_size", "8"])


def test_a_wrong_option_is_told_before_wrong_data() -> None:
    with pytest.raises(UsageError, match="no option --train"):
        parse(RunConfig, "", ["--config", "nowhere.yaml", "--train.lrr", "1"])
    with pytest.raises(UsageError, match="'outputs/run' is not an option"):
        parse(EvaluationConfig, "", ["--split", "val", "outputs/run"])


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


def test_every_job_has_its_console_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """As pip makes them of pyproject.toml; started as `vpr-train --help` and with an option that does not exist."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {f"vpr-{job}": f"jobs.console:{job}" for job in JOBS}
    command = importlib.metadata.EntryPoint("vpr-train", scripts["vpr-train"], "console_scripts").load()
    monkeypatch.setitem(sys.modules, "__main__", types.ModuleType("__main__"))
    for words, code, wanted in ((["--help"], 0, "usage: vpr-train"), (["--lr", "1"], 2, "did you mean 'train.lr'")):
        monkeypatch.setattr("sys.argv", ["/bin/vpr-train", *words])
        with pytest.raises(SystemExit) as ended:
            command()
        told = capsys.readouterr()
        assert ended.value.code == code and wanted in told.out + told.err
    assert told.err.startswith("vpr-train: ")
    with pytest.raises(AttributeError, match="no job 'trian'"):
        importlib.metadata.EntryPoint("vpr-trian", "jobs.console:trian", "console_scripts").load()
