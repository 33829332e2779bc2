"""What the documents show a person works: every shown command is run, and their links and files are there.

Commands run as they are typed, in a folder where the shown paths hold small made material; options that make the work
small are put behind them (`SMALL`). The first `accelerate launch` starts two processes; of later ones the processes
that they would start are forked from this one, in the number shown. A page's commands run in their order, so that
a later one finds what an earlier one made. One that was run for an earlier page is not run again.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from job_process import JobProcess
from launched import Launched
from tiny import make_evaluation, make_gsv, photo, run_settings
from tiny_matchers import netvlad, transvpr

from pipeline.model.weights.files import save_model

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# a line or a code span that begins like this is a command; `WORD=value` may stand before it
PROGRAM = re.compile(
    r"(?:\$ )?(?:[A-Z_]+=\S+ )*(?:python -m|accelerate launch|make|sbatch|docker|mlflow|vpr-\w+|pip)\s"
)
# commands that are run elsewhere, or that no test can run: the beginning, and where or why
ELSEWHERE = {
    "make demo": "the demo's own commands; minutes of work",
    "make test": "this is it",
    "sbatch": "tests/jobs/test_slurm.py",
    "ENGINE=fsdp2 PRECISION=bf16 sbatch": "tests/jobs/test_slurm.py",
    "accelerate launch --config_file jobs/accelerate/ddp.yaml --num_machines":
        "tests/pipeline/training/test_training_nodes.py",
    "accelerate launch --mixed_precision bf16 ...": "tests/pipeline/training/test_training_precision.py",
    "python -m jobs.evaluate --checkpoint CricaVPR.pth": "it needs the authors' file",
    "python -m jobs.locate --checkpoint outputs/cricavpr --index outputs/my_index --serve":
        "tests/jobs/test_job_locate.py",
    "python -m pytest tests/gpu": "it needs a GPU",
    "docker": "it needs Docker; tests/jobs/test_container.py runs the entry point",
    "mlflow artifacts download": "tests/pipeline/training/records/test_records_tracking.py",
}  # fmt: skip
# a page's commands of a job that tests/jobs/test_job_weights_figures.py reads from the page and runs
PAGES_ELSEWHERE = [
    ("weights.md", ["jobs.weights"]),
    ("figures.md", ["jobs.figures"]),
    ("baselines.md", ["jobs.weights"]),
]
# what makes a command small, by the job (and part) it starts; later options win
SMALL = {
    "jobs.prepare": "--out data/shown{number} --workers 1",
    "jobs.prepare verify": "",
    "jobs.miniature": "--out data/drawn{number} --places 8 --val_places 4 --test_places 4 --width 96 --height 72 "
    "--workers 1",
    "jobs.miniature streets": "--out data/drawn{number} --places 24 --street_places 4 --val_places 8 --test_places 8 "
    "--width 96 --height 72 --workers 1",
    "jobs.train": "--output launched --tracking.enabled false",
    "jobs.evaluate": "--workers 0 --figures false --track false --group_size 4",
    "jobs.evaluate rerank": "--workers 0 --figures false --track false --rerank_layer 1",
    "jobs.evaluate by": "--workers 0 --figures false --track false --rerank 4",
    "jobs.evaluate store": "--dimensions 8,4 --prefixes 8",
    "jobs.compare": "",
    "jobs.locate": "--workers 0",
    "jobs.experiment": "--output tables --data.places_per_batch 4 --train.steps 1 --tracking.enabled false "
    "--evaluate.workers 0",
    "jobs.experiment released": "--output tables --tracking.enabled false --evaluate.workers 0 --sets pitts30k",
    "jobs.mine": "--workers 0",
    "jobs.benchmark mine": "--places 300 --dim 8 --places_per_batch 8",
    "jobs.benchmark step": "--size tiny --full false --device cpu",
    "jobs.benchmark published": "--size tiny --device cpu",
    "jobs.benchmark memory": "--size tiny",
    "jobs.benchmark precision": "--size tiny --device cpu",
    "jobs.benchmark data": "--size tiny",
    "jobs.benchmark ranks": "--size tiny",
    "jobs.benchmark engines": "--engines ddp",
    "jobs.benchmark cost": "",
    "jobs.benchmark search": "--rows 300 --dim 8 --queries 20 --sklearn false",
    "jobs.benchmark search pca": "--rows 300 --dim 8 --pca 4",
    "jobs.benchmark store": "--sizes 2000x8 --queries 4 --dims 4",
}
# run by `make test-slow`: another run of a job and of a launch that the default run starts already, or half a minute
SLOW = (
    "python -m jobs.benchmark memory", "python -m jobs.benchmark precision", "python -m jobs.benchmark data",
    "python -m jobs.benchmark ranks", "python -m jobs.benchmark engines", "python -m jobs.benchmark search --pca",
    "python -m jobs.benchmark store", "python -m jobs.benchmark step --size vitb",
    "accelerate launch --config_file jobs/accelerate/ddp.yaml -m jobs.train",
    "python -m jobs.train --config jobs/configs/mixvpr.yaml",
    "python -m jobs.train --config jobs/configs/cricavpr.yaml --train.passes joint",
    "python -m jobs.evaluate --checkpoint outputs/cricavpr --groups single,bank",
    "python -m jobs.experiment --table one_photo",
    "python -m jobs.experiment --table mined",
    "python -m jobs.experiment --table sota --released weights/released --root data",
    "OMP_NUM_THREADS=1 python -m jobs.experiment",
    "python -m jobs.experiment --table ablation_crica --config jobs/configs/paper.yaml --root data --seeds",
)  # fmt: skip


@dataclass(frozen=True)
class Shown:
    """A command of a page."""

    page: str
    text: str

    @property
    def elsewhere(self) -> str | None:
        if (self.page, self.text.split()[2:3]) in PAGES_ELSEWHERE:
            return "tests/jobs/test_job_weights_figures.py"
        return next((where for start, where in ELSEWHERE.items() if self.text.startswith(start)), None)

    @property
    def slow(self) -> bool:
        return self.text.startswith(SLOW)

    @property
    def words(self) -> list[str]:
        """With the options that make it small."""
        words = shlex.split(self.text)
        if "--help" in words:
            return words
        at = words.index("-m")
        kind = words[at + 1] + (f" {words[at + 2]}" if words[at + 1] == "jobs.benchmark" else "")
        for option, what in (("--verify", " verify"), ("--from_store", " store"), ("--pca", " pca"),
                             ("--rerank_by", " by"), ("--rerank", " rerank"),
                             ("--released", " released"), ("--street_places", " streets")):  # fmt: skip
            kind += what if option in words and kind + what in SMALL else ""
        return words + shlex.split(SMALL[kind].format(number=COMMANDS.index(self)))


def shown(page: Path) -> list[Shown]:
    """The commands of a page in their order: lines of shell blocks, indented lines, and code spans."""
    text = page.read_text().replace("\\\n", " ")
    found = []
    blocks = r"(?m)```(?:sh|bash|console)?\n(.*?)```|^ {4}(?=\S)([^\n]+)|(?<!`)`([^`\n]+)`(?!`)"
    for block, *line_or_span in re.findall(blocks, text, re.DOTALL):
        for line in block.splitlines() or ["".join(line_or_span)]:
            command = re.sub(r"\s+", " ", re.split(r"\s+#|\s{2,}then ", line)[0]).strip().removeprefix("$ ")
            if PROGRAM.match(command + " ") and command != "accelerate launch":
                found.append(Shown(page.name, command))
    return list(dict.fromkeys(found))


pytestmark = pytest.mark.timeout(1800)  # a page is many commands; a busy machine
ALL = {page.name: shown(page) for page in PAGES}
COMMANDS = [command for commands in ALL.values() for command in commands]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as the pages assume it: data, photos, configurations made small, and two trained runs."""
    world = tmp_path_factory.mktemp("world")
    (world / "jobs").mkdir()
    (world / "jobs" / "accelerate").symlink_to(ROOT / "jobs" / "accelerate")
    small = run_settings(world)
    small["train"] = {"steps": 2, "epochs": 1, "validate_first": False, "log_every": 1}
    small["data"]["workers"] = 0
    small["model"]["backbone"]["weights"] = None
    for name in ("name", "output", "tracking"):
        del small[name]
    del small["data"]["shards"], small["validate"]["sets"]
    (world / "jobs" / "configs").mkdir()
    for name in {word for c in COMMANDS for word in re.findall(r"jobs/configs/\S+\.yaml", c.text)}:
        (world / name).write_text(yaml.safe_dump(over(yaml.safe_load((ROOT / name).read_text()), small)))
    make_gsv(world / "data" / "gsv-cities")
    (world / "data" / "city").mkdir()
    (world / "data" / "city" / "gsv").symlink_to(world / "data" / "gsv-cities")
    (world / "data" / "streets").symlink_to(world / "data" / "city")
    for split in ("train", "val", "test"):
        make_evaluation(world / "data" / "pitts30k", split=split)
    (world / "data" / "city" / "eval").mkdir()
    (world / "data" / "city" / "eval" / "miniature").symlink_to(world / "data" / "pitts30k")
    for name in ("city_0", "city_7"):
        (world / "data" / name).symlink_to(world / "data" / "pitts30k")
    for view, walk in enumerate(("day_left", "day_right", "night_right")):
        (world / "data" / "gardens_point" / walk).mkdir(parents=True)
        for place in range(8):
            photo(place, view).save(world / "data" / "gardens_point" / walk / f"Image{place:03d}.jpg")
    (world / "my" / "photos").mkdir(parents=True)
    for number in range(6):
        photo(number, 0).save(world / "my" / "photos" / f"{number}.jpg")
    rows = ["image,role,positives"]
    for place in range(6):
        (world / "my" / "places" / f"place-{place}").mkdir(parents=True)
        for view in range(5):
            photo(place, view).save(world / "my" / "places" / f"place-{place}" / f"{view}.jpg")
        rows.append(f"places/place-{place}/0.jpg,database,")
        rows.append(f"places/place-{place}/4.jpg,query,places/place-{place}/0.jpg")
    (world / "my" / "check.csv").write_text("\n".join(rows) + "\n")
    for name in ("query.jpg", "A.jpg", "B.jpg"):
        photo(2, 1).save(world / name)
    before = Path.cwd()
    os.chdir(world)
    try:
        run(["jobs.prepare", "--source", "data/gsv-cities", "--out", "data/shards", "--rounds", "2"], world)
        for name in ("city_shards", "own_shards", "streets_shards"):
            (world / "data" / name).symlink_to(world / "data" / "shards")
        run(["jobs.train", "--config", "jobs/configs/cricavpr.yaml"], world)
        run(["jobs.train", "--config", "jobs/configs/cricavpr.yaml", "--name", "no-encoder"], world)
        run(
            ["jobs.evaluate", "--checkpoint", "outputs/cricavpr", "--sets", "pitts30k", "--store", "fp16",
             "--workers", "0", "--figures", "false", "--track", "false", "--group_size", "4"],
            world,
        )  # fmt: skip
    finally:
        os.chdir(before)
    (world / "outputs" / "own-photos").symlink_to(world / "launched" / "own-photos")  # its page trains it
    (world / "weights").mkdir()
    shutil.copy(
        (world / "outputs/cricavpr/checkpoints/best/model.safetensors").resolve(),
        world / "weights" / "resnet50_gem.safetensors",
    )
    for name, model in (("patch_netvlad", netvlad()), ("transvpr", transvpr())):
        save_model(model, world / "weights" / f"{name}.safetensors", model.config, model.image_size, everything=True)
    released = world / "weights" / "released"
    released.mkdir()
    (released / "transvpr_pitts30k.safetensors").symlink_to(world / "weights" / "transvpr.safetensors")
    return world


def over(values: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    both = {k: over(values[k], v) if isinstance(v, dict) and isinstance(values.get(k), dict) else v
            for k, v in given.items()}  # fmt: skip
    return {**values, **both}


def run(words: list[str], world: Path) -> str:
    """`python -m WORDS`, in a process forked from this one."""
    job = JobProcess(words[0], words[1:], world / "log")
    code = job.wait(900)
    assert code == 0 and "Traceback" not in job.text(), f"{' '.join(words)}\nended with {code}:\n{job.text()[-3000:]}"
    return job.text()


def run_launched(words: list[str], world: Path) -> None:
    """What `accelerate launch WORDS` starts, without importing everything again in each process."""
    at = words.index("-m")
    options = dict(zip(words[:at:2], words[1:at:2], strict=True))
    asked = options.get("--num_processes", yaml.safe_load(Path(options["--config_file"]).read_text())["num_processes"])
    Launched("ddp", int(asked), words[at + 1], words[at + 2 :], world / "log").done(900)


def run_as_typed(words: list[str], world: Path) -> None:
    """The whole command line, with its launcher (of two processes), in a process group of its own."""
    if "--num_processes" in words:
        words[words.index("--num_processes") + 1] = "2"
    program = shutil.which(words[0], path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    assert program is not None, words[0]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [program, *words[1:]], cwd=world, env=environment, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, (
        f"{' '.join(words)}\nended with {done.returncode}:\n{(done.stdout + done.stderr)[-4000:]}"
    )


DONE: set[str] = set()
"""Commands that ran for an earlier page."""


def run_all(commands: list[Shown], world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(world)
    for command in commands:
        if command.text in DONE:
            continue
        words = command.words
        while "=" in words[0]:
            monkeypatch.setenv(*words.pop(0).split("=", 1))
        if words[:2] == ["python", "-m"]:
            run(words[2:], world)
        elif any(done.startswith("accelerate launch") for done in DONE):
            run_launched(words[2:], world)
        else:
            run_as_typed(words, world)
        DONE.add(command.text)


def to_run(slow: bool) -> dict[str, list[Shown]]:
    """Page -> what is run for it; pages without any are left out."""
    chosen = {page: [c for c in commands if not c.elsewhere and c.slow == slow] for page, commands in ALL.items()}
    return {page: commands for page, commands in chosen.items() if commands}


@pytest.mark.parametrize("page", to_run(slow=False))
def test_shown_commands_run(page: str, world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_all(to_run(slow=False)[page], world, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("page", to_run(slow=True))
def test_shown_commands_that_take_longer_run(page: str, world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_all(to_run(slow=True)[page], world, monkeypatch)


def test_the_page_about_python_runs(world: Path) -> None:
    """All its code blocks, one after the other, in a fresh interpreter; what it loads names what it says."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)
    assert len(blocks) >= 5
    (world / "page.py").write_text("\n".join(blocks) + "\nassert descriptors.shape == (6, model.descriptor_dim)\n")
    run_as_typed(["python", "page.py"], world)


def test_every_shown_command_is_run_somewhere() -> None:
    assert len(COMMANDS) > 30
    for command in COMMANDS:
        if command.elsewhere is None:
            assert command.words, command  # SMALL knows the job
        elif command.elsewhere.startswith("tests/"):
            assert (ROOT / command.elsewhere).exists(), command
    for page, (job,) in PAGES_ELSEWHERE:  # the lines that the other file finds are all that the page shows
        there = re.findall(rf"^ *python -m {re.escape(job)} ", (ROOT / "docs" / page).read_text(), re.MULTILINE)
        assert len(there) == sum(f"python -m {job} " in command.text for command in ALL[page]) > 0, page
    texts = [c.text for c in COMMANDS]
    for start in (*ELSEWHERE, *SLOW):
        assert any(text.startswith(start) for text in texts), f"no page shows {start}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_have_one_spelling(page: Path) -> None:
    """Underscores, as in a YAML file; those of other programs (make, mlflow) have theirs."""
    for command in ALL[page.name]:
        if " jobs." in command.text:
            wrong = [word for word in command.text.split() if re.match(r"--[a-z_.]+-", word)]
            assert not wrong, f"{page.name}: {command.text}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", text):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
    for named in re.findall(r"`((?:jobs|tests|docs|pipeline|shards)/[\w/.-]+\.(?:py|yaml|md|sbatch))(?:::\w+)?`", text):
        assert (ROOT / named).exists(), f"{page.name} names {named}"


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for page in PAGES:
        for target in re.findall(r"(?:`|^)make ([a-z][a-z-]+)", page.read_text(), re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{page.name} shows make {target}"
