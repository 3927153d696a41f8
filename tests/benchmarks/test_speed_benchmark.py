"""The arithmetic of the speed benchmark, and its protocol with a side that does not learn."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import floor
import jax
import jax.numpy as jnp
import operations
import pytest
import worker
from speed import tables
from works import SIZES, WORKS, Work

import run
from delayrl.agents.sac import SAC
from delayrl.core import replay as ring
from delayrl.core.types import Spec

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
DUMMY = {"kind": "dummy", "env": "InvertedPendulum-v5", "delay": 0, "seeds": 1, "device": "cpu", "options": {}}


def test_products_are_counted_by_hand() -> None:
    """Two layers of 8 → 16 → 4 at 32 rows: forward, both weights' gradients, and the one inner inputs' gradient."""
    w1, w2, x = jnp.ones((8, 16)), jnp.ones((16, 4)), jnp.ones((32, 8))

    def loss(w: tuple[jax.Array, jax.Array]) -> jax.Array:
        return ((jax.nn.relu(x @ w[0]) @ w[1]) ** 2).sum()

    first, second = 2 * 32 * 8 * 16, 2 * 32 * 16 * 4
    assert floor.matmul_flops(loss, (w1, w2)) == first + second
    assert floor.matmul_flops(jax.grad(loss), (w1, w2)) == 2 * first + 3 * second

    def often(w: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jax.lax.scan(lambda total, _: (total + loss(w), None), 0.0, None, length=7)[0]

    assert floor.matmul_flops(often, (w1, w2)) == 7 * (first + second)
    every_second = lambda i: jax.lax.cond(i % 2 == 0, lambda: loss((w1, w2)), lambda: 0.0)  # noqa: E731
    assert floor.matmul_flops(every_second, jnp.int32(0)) == (first + second) / 2
    assert floor.matmul_flops(jax.vmap(lambda a: a @ w1), jnp.ones((5, 3, 8))) == 5 * 2 * 3 * 8 * 16


def test_products_agree_with_xla() -> None:
    """On products alone, batched ones too, our count is that of XLA's cost analysis."""
    a, b = jnp.ones((6, 32, 64)), jnp.ones((6, 64, 16))
    function = lambda a, b: jnp.einsum("bij,bjk->bik", a, b)  # noqa: E731
    assert floor.matmul_flops(function, a, b) == jax.jit(function).lower(a, b).cost_analysis()["flops"]


def test_products_of_sac() -> None:
    """One critic update: twin targets forward, twin critics forward and back; every second time the actor, twice."""
    agent, spec, batch = SAC(hidden=(64, 64), batch_size=32), Spec(10, 3, 0), 32
    replay = jax.eval_shape(lambda: ring.init(spec, 100))
    key, number = jax.random.key(0), jnp.int32(0)
    windows = jax.eval_shape(lambda r: ring.sample(r, key, batch, 0, 3, number), replay)
    state = jax.eval_shape(lambda: agent.init(spec, key))
    actor, hidden, critic = 2 * batch * 10 * 64, 2 * batch * 64 * 64, 2 * batch * 13 * 64
    policy, value = actor + hidden + 2 * batch * 64 * 6, critic + hidden + 2 * batch * 64
    back = lambda forward, first: 2 * forward - first  # noqa: E731  # no gradient of the data
    learn = policy + 2 * value + 2 * (value + back(value, critic))
    # the critics' weights stand still: only the gradient of their inputs
    improve = policy + 2 * value + 2 * value + back(policy, actor) + policy
    counted = floor.matmul_flops(agent.update, state, windows, key, number)
    assert counted == pytest.approx(learn + 0.5 * 2 * improve, rel=0.02)


def test_operations_are_what_they_are() -> None:
    """Of a compiled program: products forward, for weights' gradients, of a batch; random bits; sums and the rest."""

    def program(x: jax.Array, y: jax.Array, w: jax.Array, pairs: jax.Array, key: jax.Array) -> tuple[jax.Array, ...]:
        bits = jax.lax.optimization_barrier(jax.random.bits(key, x.shape))
        attention = jnp.einsum("btd,bsd->bts", pairs, pairs)
        return jnp.tanh(x @ w), jnp.einsum("ri,ro->io", x, y), attention, jnp.cos(x).sum(0), bits

    x, y, w, pairs = jnp.ones((320, 64)), jnp.ones((320, 32)), jnp.ones((64, 48)), jnp.ones((32, 5, 64))
    text = jax.jit(program).lower(x, y, w, pairs, jax.random.key(0)).compile().as_text()
    kinds = operations.kinds(text).values()
    assert {"products, forward and for the inputs' gradients", "products of attention"} <= set(kinds)
    assert {"products for the weights' gradients", "random bits", "sums", "elementwise"} <= set(kinds)


def test_amortised() -> None:
    """A thousand updates every thousand steps cost one each step."""
    assert floor.amortised([(1, 1, 0.01), (1000, 1000, 0.02)]) == pytest.approx(0.03)
    assert floor.amortised([(1, 2, 0.01), (250, 500, 0.02)]) == pytest.approx(0.06)


def test_floor_multiplies_as_training_does(monkeypatch, capsys) -> None:
    """In the run's precision, not in the device's: a GPU's own is coarser, and faster."""
    monkeypatch.setattr(floor, "pin", lambda: None)
    monkeypatch.setattr(floor, "parts", lambda side: jax.config.jax_default_matmul_precision)
    for options, words in (({}, '"float32"'), ({"precision": "bfloat16"}, '"bfloat16"')):
        monkeypatch.setattr(sys, "argv", ["floor.py", json.dumps({"device": "cpu", "options": options})])
        floor.main()
        assert capsys.readouterr().out.strip() == words


def test_replay_bytes() -> None:
    """The table's formula is what our replay takes; the released code's is counted by its columns."""
    for sizes in ((17, 6, 5), (348, 17, 50)):
        ours, _ = tables.replay(*sizes, 1000)
        assert abs(floor.replay_bytes(Spec(*sizes), 1000) - ours) < 100
    _, theirs = tables.replay(2, 1, 3, 1)
    assert theirs == 4 * (2 + 1 + 1 + 2 + 1 + 1) + 4 * (2 + 3 * 1 + 3 * 2) + 3 * (8 + 1)


def test_ratios_pair_slices() -> None:
    """Each slice with the one beside it; of one environment step of one seed."""
    ours = [{"seconds": s, "processor": s / 2} for s in (1.0, 2.0, 4.0)]
    peer = [{"seconds": s, "processor": s} for s in (3.0, 4.0, 4.0)]
    ratios = run.ratios(ours, peer, 1, 1)
    assert ratios["ratio"]["median"] == 2
    assert ratios["processor_ratio"]["median"] == 4
    assert run.ratios(ours, peer, 4, 1)["ratio"]["median"] == 8
    assert run.quartiles([4, 1, 3, 2, 5]) == {"median": 3, "low": 2, "high": 4}


def test_protocol() -> None:
    """A side starts, runs exactly the slices that it is asked for, and stops."""
    side = run.Side(sys.executable, DUMMY | {"name": "test", "warmup": 10}, threads=1)
    try:
        assert {"gymnasium", "mujoco"} <= side.hello["packages"].keys()
        short, long = side.slice(20), side.slice(4000)
    finally:
        side.close()
    assert 0 < short["seconds"] < long["seconds"]
    assert long["processor"] <= 1.2 * long["seconds"]
    assert long["peak_bytes"] > 1e6
    assert side._process.returncode == 0


def test_the_fastest_way_of_a_peer_is_measured(monkeypatch) -> None:
    """Of several processes the fastest stays, and the others end."""

    class Timed:
        def __init__(self, seconds: float):
            self.seconds, self.closed = seconds, False

        def slice(self, steps: int) -> dict[str, float]:
            return {"seconds": self.seconds * steps}

        def close(self) -> None:
            self.closed = True

    slow, fast = Timed(2), Timed(1)
    assert run.fastest([slow, fast], 10) is fast
    assert (slow.closed, fast.closed) == (True, False)
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    assert run.environment(2, "passive")["OMP_WAIT_POLICY"] == "passive"
    assert "OMP_WAIT_POLICY" not in run.environment(2)


def test_a_side_that_fails_leaves_none_behind(monkeypatch) -> None:
    """Started in two ways: where the second fails, at its start or later, the first ends too."""
    left = set()

    class Failing:
        def __init__(self, python: str, side: dict, threads: int, waiting: str):
            if waiting == "fails at once":
                raise run.MeasurementError
            self.waiting = waiting
            left.add(waiting)

        def slice(self, steps: int) -> dict[str, float]:
            if self.waiting:
                raise run.MeasurementError
            return {"seconds": 1.0}

        def close(self) -> None:
            left.remove(self.waiting)

    monkeypatch.setattr(run, "Side", Failing)
    for way in ("fails at once", "fails later"):
        with pytest.raises(run.MeasurementError):
            run.start("python", DUMMY, 1, ("", way), 10)
        assert not left


def test_a_side_that_is_killed_says_so() -> None:
    """By the kernel, for memory, while the other side works."""
    side = run.Side(sys.executable, DUMMY | {"name": "test", "warmup": 1}, threads=1)
    side._process.kill()
    side._process.wait()
    with pytest.raises(run.MeasurementError, match="dummy cannot be measured"):
        side.slice(10)
    side.close()


def test_a_side_that_fails_says_why() -> None:
    words = r"dummy cannot be measured: .*Nonsense.*test-dummy-1-passive\.log"
    with pytest.raises(run.MeasurementError, match=words):
        run.Side(sys.executable, DUMMY | {"name": "test", "warmup": 1, "env": "Nonsense-v0"}, 1, "passive")


def test_what_could_not_be_measured_is_no_success(tmp_path: Path, monkeypatch, capsys) -> None:
    """Here there is no GPU: one line, no row, and a status."""
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    out = tmp_path / "rows.jsonl"
    monkeypatch.setattr(sys, "argv", ["run.py", "vdpo-5", "--device", "gpu", "--out", str(out)])
    assert run.main() == 2
    assert "JAX finds no gpu" in capsys.readouterr().err
    assert not out.exists()


def test_a_row_takes_the_place_of_its_older_one(tmp_path: Path) -> None:
    names = list(WORKS)
    row = {"work": names[1], "device": "cpu", "threads": 2, "value": 1}
    for more in ({}, {"work": names[0]}, {"value": 2}, {"device": "gpu"}):
        run.write(row | more, tmp_path / "rows.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [(x["work"], x["device"], x["value"]) for x in lines] == [
        (names[0], "cpu", 1),
        (names[1], "cpu", 2),
        (names[1], "gpu", 1),
    ]


@pytest.mark.parametrize(
    ("words", "said"),
    [(["--torch-python", "nowhere/python"], "cannot be started"), (["--out", "nowhere/rows"], "no folder")],
)
def test_what_is_not_there_is_said_before_anything_is_measured(words, said, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["run.py", "sac-sb3", *words])
    monkeypatch.setattr(run, "compare", lambda *_: pytest.fail("measured"))
    assert run.main() == 2
    assert said in capsys.readouterr().err


def test_other_hyperparameters_are_not_published(monkeypatch, capsys) -> None:
    """A row's title does not say them."""
    monkeypatch.setattr(sys, "argv", ["run.py", "vdpo-64", "--set", "width=8"])
    monkeypatch.setattr(run, "compare", lambda *_: pytest.fail("measured"))
    assert run.main() == 2
    assert "give --out" in capsys.readouterr().err


def test_no_works_is_no_success(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["run.py", "--sizes", "--device", "gpu"])
    assert run.main() == 2
    assert "no such works are defined for gpu" in capsys.readouterr().err


def test_sbx_is_on_the_device_that_is_asked_for(monkeypatch) -> None:
    """It would take the GPU where ours is measured on the CPU."""
    seen = []

    class Peer:
        def __init__(self, *_: object, **options: object):
            seen.append(jax.config.jax_default_device)

        def learn(self, steps: int) -> None:
            seen.append(jax.config.jax_default_device)

    monkeypatch.setitem(sys.modules, "sbx", SimpleNamespace(SAC=Peer))
    monkeypatch.setattr(worker, "register", lambda gate, task: task)
    worker.sbx(DUMMY, None)
    assert seen == [jax.devices("cpu")[0]] * 2


def test_both_sides_clone_once_a_slice() -> None:
    """One KL update a step, whatever the slice's length: the papers' schedule."""
    work: Work = WORKS["vdpo-64"]
    sys_argv, sys.argv = sys.argv, ["run.py", "--vdpo", str(BENCHMARKS)]
    try:
        args = run.arguments()
    finally:
        sys.argv = sys_argv
    sides = {role: run.complete(side, work, 20, args) for role, side in work.sides.items()}
    assert sides["ours"]["options"]["clone_every"] == sides["ours"]["options"]["clone_updates"] == 20
    assert sides["peer"]["options"]["kl_freq"] == 20
    assert sides["peer"]["options"]["embedding_dim"] == sides["ours"]["options"]["width"]
    assert len(SIZES) > 10


def test_rates_of_the_floors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the rows that a table shows. Each has its own day's, so it says which where it shows several."""
    work, size = [next(r for r in tables.read_rows() if r["work"] == name) for name in ("vdpo-64", next(iter(SIZES)))]

    def on(row: tables.Row, date: str, rate: float, **changes: str) -> tables.Row:
        rates = dict.fromkeys(row["floor"]["rates"], rate * 1e9)
        return row | {"date": date, "floor": row["floor"] | {"rates": rates}} | changes

    shown = [on(work, "2026-01-01", 100), on(work, "2026-01-01", 150)]
    hidden = [on(size, "2026-01-02", 300), on(size, "2026-01-03", 200, work=list(SIZES)[1])]
    monkeypatch.setattr(tables, "read_rows", lambda: shown + hidden)
    assert tables.floors(shown + hidden).endswith("|\n\nThe best rate seen: 150 GFLOP/s.")
    later = [*shown, on(work, "2026-01-02", 50)]
    words = "The best rate seen: 150 GFLOP/s (2026-01-01), 300 GFLOP/s (2026-01-02)."
    assert tables.floors(later + hidden).endswith(words)
    assert "rate" not in tables.floors(hidden)
    flops = size["floor"]["flops"]
    lines = tables.sizes(hidden).splitlines()[2:4]
    assert [line.split(" | ")[7] for line in lines] == [
        f"{flops / 3e8:.2f} (300)",
        f"{flops / 2e8:.2f} (200)",
    ]


def test_tables_of_the_committed_rows(tmp_path: Path) -> None:
    """Every row shows, what was not run is empty, and where the peer is faster it is said."""
    rows = tables.read_rows()
    assert rows
    works = [row for row in rows if not row["work"].startswith("size-")]
    assert tables.compared(rows).count("\n") == len(works) + 1
    assert tables.sizes(rows).count("\n") == len(SIZES) + 1
    slow = json.loads(json.dumps(works[0])) | {"ratio": {"median": 0.5, "low": 0.4, "high": 0.6}}
    assert "ratio 0.50" in tables.behind([slow])
    slow["peer"]["waiting"] = "passive"
    assert f"{slow['peer']['steps_per_second']:.1f} (asleep) |" in tables.compared([slow])
    assert not tables.behind([works[0] | {"ratio": {"median": 2.0, "low": 1, "high": 3}}])
    size = next(row for row in rows if row["work"].startswith("size-"))
    alone = size | {"threads": 1, "ours": size["ours"] | {"steps_per_second": 12345.0}}
    assert tables.sizes([*rows, alone]) == tables.sizes(rows)
    gpu = json.loads(json.dumps(works[0] | {"device": "gpu"}))
    gpu["versions"] |= {"device": "Some GPU", "cores": 123}
    cpu, other = tables.provenance([*rows, gpu]).split("\n\n")
    assert cpu == tables.provenance(rows)
    assert "123 x86 cores (Some GPU)" in other
    assert tables.spent(gpu) == gpu["ours"]["seconds"]["median"]  # its floor is the GPU's, not the processor's
    assert tables.spent(works[0]) == works[0]["ours"]["processor"]["median"] / works[0]["threads"]
    for table in (tables.resources, tables.parts):
        assert "(gpu, " not in table(rows)
        assert f"(gpu, {gpu['threads']} threads) |" in table([*rows, gpu])
    tables.draw_sizes(rows, tmp_path / "sizes.png")
    assert (tmp_path / "sizes.png").stat().st_size > 5000
