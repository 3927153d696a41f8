"""What a script does with runs: curves, training episodes, callbacks, lists of runs, evaluation."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import delayrl
from delayrl.cli.compare import differences
from delayrl.cli.main import main
from delayrl.play.evaluation import RANDOM_ACTIONS, TRAINING, reset_seed
from delayrl.play.policy import Policy
from delayrl.play.run import Run
from delayrl.run.folder import RunFolder
from short_runs import assert_same_networks, killed_and_resumed, newest, train


def test_curves_are_those_of_the_rows(vdpo: Run) -> None:
    for policy in ("agent", "reference"):
        steps, returns = vdpo.curve(policy)
        assert steps.tolist() == [100, 200, 300]
        rows = [row for row in vdpo.rows() if row["policy"] == policy]
        np.testing.assert_array_equal(returns, np.reshape([row["return"] for row in rows], (3, 2)))
    with pytest.raises(delayrl.DelayRLError, match=r"^a curve is that of \"agent\" or \"reference\"; got 'refrence'$"):
        vdpo.curve("refrence")


def test_a_curve_leaves_out_what_a_crash_cut(vdpo: Run, tmp_path: Path) -> None:
    """An evaluation with fewer episodes than the others, and the half of a line."""
    kept = [row for row in vdpo.rows() if row["policy"] == "agent"]
    text = "".join(json.dumps(row) + "\n" for row in kept)
    (tmp_path / "config.json").write_text(json.dumps(vdpo.config))
    (tmp_path / "rows.jsonl").write_text(text[:-9])
    steps, returns = delayrl.Run(tmp_path).curve()
    assert steps.tolist() == [100, 200]
    np.testing.assert_array_equal(returns, np.reshape([row["return"] for row in kept[:4]], (2, 2)))
    (tmp_path / "rows.jsonl").write_text("")
    nothing = delayrl.Run(tmp_path).curve()
    assert (nothing.steps.shape, nothing.returns.shape) == ((0,), (0, 0))


def test_a_run_outlives_a_change_of_the_directory(vdpo: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(vdpo.path.parent)
    near = Run(vdpo.path.name)
    monkeypatch.chdir(tmp_path)
    assert (near, hash(near), near.rows()) == (vdpo, hash(vdpo), vdpo.rows())
    assert str(near.path) == vdpo.path.name, "it is shown as it was given"


def test_what_is_no_run(vdpo: Run, tmp_path: Path) -> None:
    """Folders without a configuration, the folder of several seeds, and what is no folder at all."""
    for read in (Run.rows, Run.metrics, Run.episodes, Run.curve):
        with pytest.raises(delayrl.DelayRLError, match=r"nowhere is not a run folder: it has no config.json$"):
            read(delayrl.Run("nowhere"))
    for seed in (10, 3):
        (tmp_path / f"seed{seed}").mkdir()
        (tmp_path / f"seed{seed}" / "config.json").write_text(json.dumps(vdpo.config))
    for use in (delayrl.evaluate, delayrl.load, lambda run: delayrl.train("bpql", "Reacher-v5", 3, start_from=run)):
        with pytest.raises(delayrl.DelayRLError) as error:
            use(tmp_path)
        assert str(error.value).endswith(f"config.json; its runs are {tmp_path / 'seed3'}, {tmp_path / 'seed10'}")
        with pytest.raises(delayrl.DelayRLError, match=r"`delayrl runs .*` lists the runs below it$"):
            use(tmp_path.parent)
        with pytest.raises(delayrl.DelayRLError, match="it is a bundle, for `load_bundle`"):
            use(Path(__file__).parents[1] / "data" / "bundle-0.1")
    for use in (delayrl.Run, delayrl.load, delayrl.evaluate):
        for thing, got in (([vdpo, vdpo], "this is a list of runs"), (3, "got 3"), (None, "got None")):
            with pytest.raises(delayrl.DelayRLError, match=f"^give one run, or the path of its folder; {got}$"):
                use(thing)


def test_a_damaged_run_is_listed(tmp_path: Path) -> None:
    """One that vanished from the list would be taken for deleted. A config.json of others is left out."""
    for name in ("ours", "others"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{")
    (tmp_path / "ours" / "rows.jsonl").write_text("")
    (listed,) = delayrl.runs(tmp_path)
    with pytest.raises(delayrl.DelayRLError, match=r"ours.config\.json is damaged"):
        _ = listed.config


def test_episodes_of_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reacher's last 50 steps: one after the other, none twice or lost where the process died in the midst of one."""
    whole = train("bpql", tmp_path / "whole", seed=3, steps=320)
    episodes = whole.episodes()
    assert [row["step"] for row in episodes] == [50, 100, 150, 200, 250, 300]
    assert [row["episode"] for row in episodes] == list(range(6))
    assert {(row["length"], row["seed"]) for row in episodes} == {(50, 3)}
    cut = killed_and_resumed("bpql", tmp_path / "cut", monkeypatch, seed=3, steps=320)
    assert cut.episodes() == episodes


def test_returns_of_training_are_sums_of_rewards(tmp_path: Path) -> None:
    """The random agent's actions are known, so its episodes can be played again."""
    run = train("random", tmp_path / "run", steps=100, random_steps=100)
    env = delayrl.make("Reacher-v5", 3, rescale=True)
    rewards, at = [], iter(range(100))

    for episode in range(2):
        env.reset(seed=reset_seed(0, TRAINING, episode))
        total = 0.0
        for _ in range(50):
            action = np.random.default_rng([0, RANDOM_ACTIONS, next(at)]).uniform(-1, 1, 2).astype(np.float32)
            total += float(env.step(action)[1])
        rewards.append(total)
    np.testing.assert_allclose([row["return"] for row in run.episodes()], rewards, rtol=1e-6)


def test_a_callback_sees_each_evaluation_and_may_stop(tmp_path: Path) -> None:
    seen = []

    def stop_at_200(step: int, runs: list[Run]) -> bool:
        seen.append((step, len(runs[0].rows()), newest(runs[0]).step))
        return step == 200

    run = train("bpql", tmp_path / "run", callback=stop_at_200)
    assert seen == [(100, 2, 100), (200, 4, 200)]
    assert run.curve().steps.tolist() == [100, 200]
    assert (run.path / "curve.png").exists()
    whole = train("bpql", tmp_path / "whole")
    assert train("bpql", tmp_path / "run").rows() == whole.rows()
    assert_same_networks(run, whole)


def test_runs_of_a_folder(tmp_path: Path) -> None:
    """Wherever below it they are; other files named alike are left out."""
    made = [train("random", tmp_path / name, steps=100, random_steps=100) for name in ("b/deep", "a")]
    for name, text in (("other", "{}"), ("list", "[1]"), ("broken", "{")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(text)
    assert delayrl.runs(tmp_path) == [made[1], made[0]]
    assert delayrl.runs(str(tmp_path / "b")) == [made[0]]
    with pytest.raises(delayrl.DelayRLError, match="there is no folder"):
        delayrl.runs(tmp_path / "nowhere")


def test_a_run_gives_its_policy(vdpo: Run) -> None:
    """The same as `load`; and a run is a path, equal to another of the same folder."""
    obs, info = delayrl.make("Reacher-v5", 3).reset(seed=1)
    np.testing.assert_array_equal(vdpo.policy().act(obs, info), delayrl.load(vdpo.path).act(obs, info))
    assert Path(vdpo) == vdpo.path
    assert {delayrl.Run(str(vdpo.path)), vdpo} == {vdpo}
    assert repr(vdpo) == f"Run({str(vdpo.path)!r})"


def test_evaluate_takes_a_run_its_folder_or_a_policy(vdpo: Run) -> None:
    result = delayrl.evaluate(vdpo, episodes=2)
    assert delayrl.evaluate(str(vdpo.path), episodes=2) == result
    policy = delayrl.load(vdpo)
    assert str(policy.task) == result["env"] == "Reacher-v5"
    assert delayrl.evaluate(policy, episodes=2)["returns"] == result["returns"]
    assert delayrl.evaluate(policy, episodes=2, env="Reacher-v5", delay=1)["delay"] == 1
    nowhere = Policy(policy.agent, policy.state, policy.spec, policy.low, policy.high)
    assert delayrl.evaluate(nowhere, episodes=2, env="Reacher-v5", delay=3)["returns"] == result["returns"]
    with pytest.raises(delayrl.DelayRLError, match="this policy does not say what its task is: give env"):
        delayrl.evaluate(nowhere)
    with pytest.raises(delayrl.DelayRLError, match="leave agent out"):
        delayrl.evaluate(policy, agent="vdpo")


def test_a_policy_knows_its_delay(tmp_path: Path) -> None:
    """Without one given, it is evaluated under that of its training, and it warns of ages that it never learned."""
    run = train("random", tmp_path / "run", delay="uniform:1:3", steps=100, random_steps=100)
    policy = delayrl.load(run)
    result = delayrl.evaluate(policy, episodes=2)
    assert result["delay"] == "uniform:1:3"
    assert result["returns"] == delayrl.evaluate(run, episodes=2)["returns"]
    with pytest.warns(delayrl.DelayWarning, match="learned no age below 1 steps, and delay 0 shows younger ones"):
        delayrl.evaluate(policy, episodes=1, delay=0)


def test_runs_on_the_command_line(vdpo: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["runs", str(vdpo.path.parent)])
    head, row = capsys.readouterr().out.splitlines()
    assert head.split() == ["agent", "preset", "env", "delay", "seed", "steps", "return", "run"]
    assert row.split()[:6] == ["vdpo", "small", "Reacher-v5", "3", "0", "300"]
    assert row.split()[6] == f"{vdpo.curve().returns[-1].mean():,.1f}"
    train("random", tmp_path / "part", steps=200, random_steps=100, callback=lambda step, runs: True)
    main(["runs", str(tmp_path), "--json"])
    (part,) = json.loads(capsys.readouterr().out)
    assert (part["agent"], part["step"], part["steps"]) == ("random", 100, 200)


def test_a_run_of_another_format_hides_no_other(vdpo: Run, tmp_path: Path, capsys) -> None:
    for name, format in (("a", 2), ("b", 1)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(json.dumps(vdpo.config | {"format": format}))
        (tmp_path / name / "rows.jsonl").write_text((vdpo.path / "rows.jsonl").read_text())
    line = f"{tmp_path / 'a' / 'config.json'} has format 2; this version reads 1"
    main(["runs", str(tmp_path)])
    _, other, good = capsys.readouterr().out.splitlines()
    assert other.split(maxsplit=7) == [*"-------", line]
    assert (good.split()[0], good.split()[-1]) == ("vdpo", str(tmp_path / "b"))
    main(["runs", str(tmp_path), "--json"])
    other, good = json.loads(capsys.readouterr().out)
    assert (other["run"], other["error"], other["return"]) == (str(tmp_path / "a"), line, None)
    assert (good["run"], good["error"], good["step"]) == (str(tmp_path / "b"), None, 300)


def test_compare(vdpo: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Options that differ, by name; intervals where there are seeds; a picture."""
    train("random", tmp_path / "two", steps=200, random_steps=100, seeds=2)
    main(["compare", str(vdpo.path), str(tmp_path / "two"), "--out", str(tmp_path / "both.png")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == f"B  {tmp_path / 'two'} (2 seeds)"
    options = {line.split()[0]: line.split()[1:] for line in lines[3 : lines.index("", 3)]}
    assert options["option"] == ["A", "B"]
    assert options["agent"] == ["vdpo", "random"]
    assert options["steps"] == ["300", "200"]
    assert options["width"] == ["8", "-"]
    assert not {"env", "delay", "seed", "preset"} & options.keys()
    rows = {line.split()[0]: line for line in lines[lines.index("", 3) + 2 :]}
    assert f"{vdpo.curve().returns[-1].mean():,.1f}" in rows["A"]
    assert "[" in rows["B"]
    assert "[" not in rows["A"]
    assert (tmp_path / "both.png").stat().st_size > 5000
    with pytest.raises(SystemExit):
        main(["compare", str(vdpo.path)])
    assert capsys.readouterr().err == "delayrl: compare takes two to 8 runs; got 1\n"
    main(["compare", str(vdpo.path), str(vdpo.path), "--out", str(tmp_path / "same.png")])
    assert "all options  the same  the same" in capsys.readouterr().out


def test_compare_says_what_is_not_finished(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of several seeds the last evaluation is the last that all have; without one they stand alone."""
    train("random", tmp_path / "two", steps=300, seeds=2)
    rows = RunFolder(tmp_path / "two" / "seed1").read("rows")

    def keep(steps: set[int]) -> None:
        kept = "".join(json.dumps(row) + "\n" for row in rows if row["step"] in steps)
        (tmp_path / "two" / "seed1" / "rows.jsonl").write_text(kept)

    keep({100, 200})
    words = ["compare", str(tmp_path / "two"), str(tmp_path / "two" / "seed0"), "--out", str(tmp_path / "x.png")]
    main(words)
    shown = {line.split()[0]: line.split()[1:5] for line in capsys.readouterr().out.splitlines() if line}
    assert shown["A"] == ["200", "of", "300", "2"]
    assert shown["B"][:2] == ["300", "1"]
    first = (tmp_path / "two" / "seed0" / "rows.jsonl").read_text().splitlines()
    (tmp_path / "two" / "seed0" / "rows.jsonl").write_text("\n".join(x for x in first if '"step": 300' in x) + "\n")
    with pytest.raises(SystemExit):
        main(words)
    assert "no evaluation at a common step; name runs alone" in capsys.readouterr().err


def test_compare_does_not_pool_other_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As the seeds of one folder: trained one after the other, they may differ. A copy of one does not count."""
    train("random", tmp_path / "two", steps=200, random_steps=100, seeds=2)
    shutil.copytree(tmp_path / "two" / "seed0", tmp_path / "two" / "seed0-copy")
    pair = ["compare", str(tmp_path / "two"), str(tmp_path / "two" / "seed0"), "--out", str(tmp_path / "both.png")]
    main(pair)
    assert f"A  {tmp_path / 'two'} (2 seeds)" in capsys.readouterr().out
    train("random", tmp_path / "two" / "seed2", seed=2, steps=200, random_steps=150)
    with pytest.raises(SystemExit):
        main(pair)
    line = f"delayrl: the seeds in {tmp_path / 'two'} differ in random_steps; name runs alone\n"
    assert capsys.readouterr() == ("", line)


def test_compare_says_what_a_run_began_from() -> None:
    origin = {"agent": "bpql", "env": "Walk", "delay": 2, "seed": 0, "step": 400, "networks": 5 * "d2e63b2c5ccd"}
    own, other = {"delay": "<Burst:5>", "unnamed": {"delay": "99ff"}}, {"delay": 5}
    assert differences([own, other]) == [["delay", "<Burst:5>", 5], ["what delay holds", "99ff", "-"]]
    (row,) = differences([{"agent": "bpql"}, {"agent": "bpql", "origin": {"from": origin}}])
    assert row == ["from", "-", "bpql at step 400, d2e63b2c"]


def test_compare_draws_what_it_can(vdpo: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Another kind of file is refused before anything is printed."""
    with pytest.raises(SystemExit):
        main(["compare", str(vdpo.path), str(vdpo.path), "--out", str(tmp_path / "cmp.xyz")])
    assert capsys.readouterr() == ("", f"delayrl: --out must end in .png, .pdf or .svg; got {tmp_path / 'cmp.xyz'}\n")
