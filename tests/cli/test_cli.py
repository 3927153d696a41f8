"""What a user types. Errors: one line on stderr, exit status 2, no traceback."""

import argparse
import errno
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import delayrl
from delayrl.agents.registry import AGENTS
from delayrl.cli.console import Parser, name_and_value
from delayrl.cli.main import COMMANDS, main
from delayrl.cli.train import add_options
from delayrl.run.configuration import options
from short_runs import newest, refused

SMALL = ["--steps", "240", "--random-steps", "100", "--evaluate-every", "120", "--evaluation-episodes", "2"]
SMALL += ["--batch-size", "8", "--hidden", "8", "8", "--replay-capacity", "250"]
TINY = [*SMALL, "--representation", "mlp", "--clone-every", "50", "--clone-updates", "5", "--quiet"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "run"
    main(["train", "vdpo", "--env", "Reacher-v5", "--delay", "3", "--out", str(path), *TINY])
    return path


def test_train_ends_with_a_summary(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same command on a complete run says so, trains nothing, and shows the summary again."""
    main(["train", "vdpo", "--env", "Reacher-v5", "--delay", "3", "--out", str(run), *TINY[:-1]])
    out, err = capsys.readouterr()
    assert "already complete at step 240" in err
    assert "delay: 3 steps = 60 ms\n" in err
    for words in ("return under delay", "its reference, no delay", str(run), "delayrl evaluate", "curve.png"):
        assert words in out


def test_a_delay_in_time(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is rounded up to steps, and says to how many."""
    main(["train", "vdpo", "--env", "Reacher-v5", "--delay", "50ms", "--out", str(run), *TINY[:-1]])
    out, err = capsys.readouterr()
    assert "delay: 3 steps of 20 ms\n" in err
    main(["train", "vdpo", "--env", "Reacher-v5", "--delay", "50ms", "--out", str(run), *TINY])
    assert capsys.readouterr() == (out, "")


def test_evaluate(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["evaluate", str(run), "--episodes", "3", "--seed", "1", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert list(result) == ["agent", "env", "delay", "step", "episodes", "mean_return", "std_return", "returns"]
    assert (result["agent"], result["delay"], len(result["returns"])) == ("vdpo", 3, 3)
    assert result["mean_return"] == pytest.approx(sum(result["returns"]) / 3)
    main(["evaluate", str(run), "--episodes", "3", "--seed", "1"])
    assert capsys.readouterr().out.endswith(f" over 3 episodes, the lowest {min(result['returns']):.1f}\n")
    main(["evaluate", str(run), "--episodes", "1"])  # one episode has no deviation
    out = capsys.readouterr().out
    assert " over 1 episode, " in out
    assert "±" not in out
    main(["evaluate", str(run), "--episodes", "1", "--json"])
    assert json.loads(capsys.readouterr().out)["std_return"] is None
    main(["evaluate", str(run), "--episodes", "3", "--delay", "1"])
    out, err = capsys.readouterr()
    assert "delay 1" in out
    assert not err
    unfinished = tmp_path / "unfinished"
    shutil.copytree(run, unfinished)
    config = json.loads((run / "config.json").read_text())
    config["schedule"]["steps"] = 1000
    (unfinished / "config.json").write_text(json.dumps(config))
    for more in ([], ["--json"]):
        main(["evaluate", str(unfinished), "--episodes", "1", *more])
        assert "is not finished: this is its policy after 240 of 1,000 steps" in capsys.readouterr().err
    main(["export", str(unfinished), "--out", str(tmp_path / "a bundle")])
    out, err = capsys.readouterr()
    assert f"delayrl latency '{tmp_path}/a bundle'" in out
    assert "is not finished: this is its policy after 240 of 1,000 steps" in err
    assert "`delayrl export" in refused(capsys, "latency", str(run))
    assert "does not fit the env given" in refused(capsys, "evaluate", str(run), "--env", "Pendulum-v1")


def watch(*words: object) -> subprocess.CompletedProcess[str]:
    """In a process of its own: rendering needs a fresh MuJoCo. Where there is no EGL, one line says so."""
    done = subprocess.run([sys.executable, "-m", "delayrl", "watch", *map(str, words)], capture_output=True, text=True)
    if "cannot be rendered here" in done.stderr:
        assert done.stderr.count("\n") == 1
        pytest.skip("no EGL here")
    return done


@pytest.mark.parametrize(
    ("kind", "frames", "rest", "said"),
    [
        ("gif", 18, [], ": 50 steps, return -"),
        ("gif", 26, ["--seconds", "2"], ": episode 2, 21 steps, return -"),  # the last of 18 stays 0.5 s, then 8
        ("mp4", 51, ["--compare"], ": 50 steps, return -"),
    ],
)
def test_watch(run: Path, kind: str, frames: int, rest: list[str], said: str, tmp_path: Path) -> None:
    """Reacher has 50 frames a second, of which a GIF shows every third, and the last."""
    out = tmp_path / f"episode.{kind}"
    compare = rest == ["--compare"]
    done = watch(run, "--out", out, *rest, *([run] if compare else []))
    assert done.stderr == ""
    assert said in done.stdout
    assert done.stdout.count("steps, return -") == (2 if compare else 1)
    look = "import sys, imageio.v3; v = imageio.v3.imread(sys.argv[1]); print([*v.shape, int(v[-1, 60:].std())])"
    decoded = subprocess.run([sys.executable, "-c", look, str(out)], capture_output=True, text=True)
    *shape, contrast = json.loads(decoded.stdout)
    assert shape == [frames, 480, 964 if compare else 480, 3]
    assert contrast > 10  # the last frame is not empty


def test_watch_ends_quietly(run: Path, tmp_path: Path) -> None:
    """OpenGL's exceptions at the end of a process are not shown, after an error neither."""
    done = watch(run, "--out", tmp_path / "no" / "such" / "folder.mp4")
    assert done.returncode == 2
    assert done.stderr.startswith("delayrl: cannot write ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2),
        (".5", 0.5),
        ("-1e3", -1000.0),
        ("true", True),
        ("False", False),
        ("None", None),
        ("[1, 2]", [1, 2]),
        ('{"a": null}', {"a": None}),
        ("'7'", "7"),
        ("arm.xml", "arm.xml"),
        ("2024-01-02", "2024-01-02"),
        ("a=b", "a=b"),
        ("", ""),
    ],
)
def test_values_of_keyword_arguments(text: str, value: object) -> None:
    assert name_and_value(f"name={text}") == ("name", value)
    assert type(name_and_value(f"name={text}")[1]) is type(value)


def test_a_keyword_argument_of_thousands_of_brackets() -> None:
    with pytest.raises(delayrl.DelayRLError, match=r"^the value of name is nested too deeply$"):
        name_and_value("name=" + "[" * 3000 + "]" * 3000)


def test_a_run_folder_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    line = "there is no run folder runs/nowhere/seed0; `delayrl runs` lists the runs below runs/"
    assert line in refused(capsys, "train", "runs/nowhere/seed0", "--steps", "300")


def test_watch_compares_on_one_task(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other"
    shutil.copytree(run, other)
    (other / "config.json").write_text(json.dumps(json.loads((run / "config.json").read_text()) | {"env": "Ant-v5"}))
    words = ("watch", str(run), "--out", str(tmp_path / "x.gif"), "--compare", str(other))
    assert "--compare takes a run on Reacher-v5; got one on Ant-v5" in refused(capsys, *words)


def given(*words: str) -> argparse.Namespace:
    """What `delayrl train vdpo` makes of its words."""
    parser = Parser(prog="train")
    add_options(parser, ["vdpo"])
    return parser.read(["vdpo", "--env", "Reacher-v5", *words])


@pytest.mark.parametrize("words", ["32,16,8", "32 16 8", "32,16 8", "3.2e1,1_6,8"])
def test_several_numbers(words: str) -> None:
    assert given("--hidden", *words.split()).hidden == [32, 16, 8]
    assert given("--log-std-range", "-20,2").log_std_range == [-20.0, 2.0]
    assert given("--log-std-range", "-20", "2").log_std_range == [-20.0, 2.0]


@pytest.mark.parametrize("text", ["100000", "1e5", "100_000", "1.0e+5"])
def test_whole_numbers(text: str) -> None:
    assert given("--steps", text).steps == 100_000
    assert type(given("--steps", text).steps) is int


@pytest.mark.parametrize("option", ["--random-steps", "--random_steps"])
def test_underscores(option: str) -> None:
    """In the name of an option; a value keeps its own."""
    assert given(option, "7").random_steps == 7
    assert given(f"{option}=7", "--out=a_b", "--env=x_y") == given(
        "--random-steps", "7", "--out", "a_b", "--env", "x_y"
    )
    assert given("--out=a_b").out == Path("a_b")


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"delayrl {delayrl.__version__}\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert f"delayrl {command}" in capsys.readouterr().out


def test_tables(capsys: pytest.CaptureFixture[str]) -> None:
    main(["agents"])
    out = capsys.readouterr().out
    assert all(name in out for name in AGENTS)
    main(["tasks"])
    out = capsys.readouterr().out
    assert all(name in out for name in ("Ant-v5", "Humanoid-v5", "delayrl/Pusher-v4", "InvertedPendulum-v5"))


@pytest.mark.parametrize("agent", list(AGENTS))
def test_help_shows_every_hyperparameter(agent: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["train", agent, "--preset", "small", "--help"])
    assert end.value.code == 0
    out = " ".join(capsys.readouterr().out.split())
    preset = AGENTS[agent].presets["small"]
    for option in (*options(preset.agent), *options(preset.schedule)):
        assert f"--{option.name.replace('_', '-')}" in out
        assert option.help in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("train", "name the agent"),
        ("train vpdo --env Reacher-v5 --delay 3", "did you mean vdpo"),
        ("train vdpo --delay 3", "--env"),
        ("train vdpo --env InvertedPendlum-v5 --delay 3", "did you mean InvertedPendulum"),
        ("train vdpo --env Reacher-v5 --delay -3", "negative"),
        ("train vdpo --env Reacher-v5 --delay 2.5", "whole"),
        ("train vdpo --env Reacher-v5 --delay some", "number"),
        ("train vdpo --env Reacher-v5 --delay 51", "longer than an episode"),
        ("train vdpo --env Reacher-v5", "at least 1 step"),
        ("train sac --env Reacher-v5 --delay 3", "delay-free reference"),
        ("train vdpo --env CartPole-v1 --delay 3", "continuous"),
        ("train vdpo --env Reacher-v5 --delay 3 --learnin-rate 3", "did you mean --learning-rate"),
        ("train vdpo --env Reacher-v5 --lr 3", "'--lr 3'; did you mean --learning-rate, --actor-learning-rate, --"),
        ("train vdpo --env Reacher-v5 --xyz 3", "unexpected '--xyz 3' (see"),
        ("train vdpo --env Reacher-v5 --delay 3 --learning-rate high", "invalid float"),
        ("train vdpo --env Reacher-v5 --steps 2.5", "--steps: must be a whole number; got '2.5'"),
        ("train vdpo --env Reacher-v5 --seed inf", "--seed: must be a whole number; got 'inf'"),
        ("train vdpo --env Reacher-v5 --hidden 32,wide", "--hidden: must be a whole number; got 'wide'"),
        ("train vdpo --env Reacher-v5 --delay 3 --preset big", "invalid choice"),
        ("train vdpo --env Reacher-v5 --delay 3 and more", "unexpected"),
        ("bench run first --wrokers 2", "unexpected '--wrokers 2'; did you mean --workers"),
        ("bench status first --runs run --wrokers 2", "did you mean --workers? (see `delayrl bench status"),
        ("evaluate run --episode-count 2", "did you mean --episodes"),
        ("evaluate nowhere", "not a run folder"),
        ("evaluate nowhere --episods 3", "did you mean --episodes"),
        ("watch nowhere --out x.gif", "not a run folder"),
        ("watch nowhere --out x.avi", ".mp4 or .gif"),
        ("fly", "invalid choice"),
        ("", "required"),
    ],
)
def test_bad_input(arguments: str, words: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert words in refused(capsys, *arguments.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EPIPE])
def test_what_cannot_be_told_ends_no_work(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Progress goes to stderr; a log on a full disk, or a reader that is gone, must not end the run that it is of."""

    class Refuses(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(sys, "stderr", Refuses())
    main(["train", "random", "--env", "Reacher-v5", "--out", str(tmp_path / "run"), *SMALL[:8]])
    assert newest(tmp_path / "run").step == 240


def test_bad_run_folders(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(run, broken)
    assert "up to 3" in refused(capsys, "evaluate", str(broken), "--delay", "4")
    assert "at least 1" in refused(capsys, "evaluate", str(broken), "--episodes", "0")
    for folder in (broken / "checkpoints").iterdir():
        weights = folder / "agent.safetensors"
        weights.write_bytes(weights.read_bytes()[:1000])
    assert "cut or changed" in refused(capsys, "evaluate", str(broken))
    (broken / "config.json").write_text("{")
    assert "damaged" in refused(capsys, "evaluate", str(broken))


def test_runs_tells_the_steps_of_one_without_evaluations(run: Path, tmp_path: Path, capsys) -> None:
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "rows.jsonl").unlink()
    main(["runs", str(tmp_path), "--json"])
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["step"], row["steps"], row["return"]) == (240, 240, None)


def test_a_run_whose_disk_does_not_answer_hides_no_others(run: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    for name in ("a", "b"):
        shutil.copytree(run, tmp_path / name)

    def stale(path: Path) -> list[Path]:
        if path.name == "a":
            raise delayrl.DelayRLError(f"{path} cannot be read: Stale file handle")
        return []

    monkeypatch.setattr("delayrl.cli.runs.checkpoint_folders", stale)
    main(["runs", str(tmp_path), "--json"])
    first, second = json.loads(capsys.readouterr().out)
    assert ("Stale" in first["error"], second["error"]) == (True, None)


def test_a_name_that_cannot_be_shown_is_escaped(run: Path, tmp_path: Path) -> None:
    """Half of a surrogate pair in a file, or a terminal that knows ASCII alone: the table comes all the same."""
    shutil.copytree(run, tmp_path / "run")
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    (tmp_path / "run" / "config.json").write_text(json.dumps(config | {"preset": "\ud800\u00b1"}))
    plain = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    words = [sys.executable, "-m", "delayrl", "runs", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, env=plain)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\ud800\\xb1" in done.stdout


def test_stopped_run_goes_on(tmp_path: Path) -> None:
    """A polite kill ends the process at a checkpoint, with one line; the same command finishes the run."""
    command = [sys.executable, "-m", "delayrl", "train", "a-sac", "--env", "Reacher-v5", "--delay", "2"]
    command += ["--out", str(tmp_path / "run"), *SMALL, "--steps", "100000", "--random-steps", "99000"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for _ in range(600):
        if (tmp_path / "run" / "checkpoints").exists():
            break
        try:
            process.wait(0.2)
        except subprocess.TimeoutExpired:
            continue
    process.terminate()
    _, err = process.communicate(timeout=120)
    assert process.returncode == 75
    assert "goes on from there" in err
    assert "Traceback" not in err
    stopped = newest(tmp_path / "run").step
    assert stopped > 0
    assert f"stopped at step {stopped:,}" in err


@pytest.mark.parametrize(("module", "status"), [("optax.transforms", 2), ("PIL", 2), ("somebodys_module", None)])
def test_a_missing_extra_is_one_line(module: str, status: int | None, monkeypatch, capsys) -> None:
    """Modules that an extra brings; a bug in an import of another is shown as it is."""

    def missing(given: object) -> None:
        raise ModuleNotFoundError("gone", name=module)

    monkeypatch.setattr("delayrl.cli.runs.run", missing)
    with pytest.raises(SystemExit if status else ModuleNotFoundError) as stopped:
        main(["runs", "."])
    if status:
        assert stopped.value.code == status
        name = module.partition(".")[0]
        assert capsys.readouterr().err == f"delayrl: this needs {name}: pip install 'delayrl[train]'\n"
