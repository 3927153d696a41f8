"""One ring of true steps: windows stay in their episode, every start can be drawn, nothing hidden is shown."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conftest import append, record, replay_of, sample
from delayrl.core import replay as ring
from delayrl.core.types import Spec
from delayrl.core.views import view

TASK = "delayrl/Counter-v0"  # observation [t, T], reward t + 1, ends after T steps


def filled(steps: int, delay: int, capacity: int) -> tuple[ring.Replay, list, list]:
    transitions, shown = record(TASK, delay, steps)
    return replay_of(transitions, Spec(2, 1, delay), capacity), transitions, shown


def draw(replay: ring.Replay, batch: int, delay: int, ahead: int, hidden: int = 0):
    return sample(replay, jax.random.key(1), batch, delay, ahead, jnp.int32(hidden))


@pytest.mark.parametrize(("delay", "ahead", "capacity"), [(3, 3, 500), (3, 3, 60), (7, 5, 90), (1, 1, 40), (0, 3, 50)])
def test_windows_stay_in_their_episode(delay: int, ahead: int, capacity: int) -> None:
    """With a ring that is larger than the run, and with one that has been overwritten several times."""
    replay, transitions, _ = filled(300, delay, capacity)
    windows = jax.tree.map(np.asarray, draw(replay, 2000, delay, ahead))
    offset = np.arange(-delay, ahead + 1)
    number = {float(transition.action[0]): i for i, transition in enumerate(transitions)}  # actions are random
    unfinished = max(i + 1 for i, transition in enumerate(transitions) if transition.done)
    for i in range(2000):
        (now, length), valid = windows.obs[i, delay], windows.valid[i]
        stored = length if number[float(windows.action[i, delay, 0])] < unfinished else transitions[-1].next_obs[0]
        expected = (now + offset >= 0) & (now + offset <= stored)
        np.testing.assert_array_equal(valid, expected)
        np.testing.assert_array_equal(windows.obs[i, valid, 0], (now + offset)[valid])
        assert (windows.obs[i, valid, 1] == length).all()
        assert not windows.obs[i, ~valid].any()
        acted = valid & (offset < windows.lead[i])
        np.testing.assert_array_equal(windows.reward[i, acted], (now + offset + 1)[acted])
        assert not windows.reward[i, ~acted].any()
        np.testing.assert_array_equal(windows.terminated[i, acted], (now + offset + 1 == length)[acted])
        assert not windows.terminated[i, ~acted].any()
        assert windows.lead[i] == expected[delay + 1 :].sum()
        assert 1 <= windows.n_step[i] <= windows.lead[i]


def test_every_start_is_drawn_equally() -> None:
    """The last starts of an episode too; k is uniform in 1..ahead, and cut only where the episode ends."""
    replay, transitions, _ = filled(120, 2, 500)
    windows = jax.tree.map(np.asarray, draw(replay, 60_000, 2, 3))
    # a start is identified by its action, which is random
    found = Counter(windows.action[:, 2, 0].tolist())
    assert len(found) == 120
    expected = 60_000 / 120
    chi2 = sum((n - expected) ** 2 / expected for n in found.values())
    assert chi2 < 119 + 5 * np.sqrt(2 * 119)
    full = windows.n_step[windows.lead == 3]
    assert np.abs(np.bincount(full, minlength=4)[1:] / len(full) - 1 / 3).max() < 0.02
    last = {float(t.action[0]) for t in transitions if t.terminated}
    steps = {int(k) for k, a in zip(windows.n_step, windows.action[:, 2, 0], strict=True) if float(a) in last}
    assert steps == {1}


def test_official_starts() -> None:
    """With `until_end` = 3 the last two starts of an episode are never drawn, and all others are."""
    transitions, _ = record(TASK, 2, 120)
    replay = replay_of(transitions, Spec(2, 1, 2), 500, ring.Learnable(until_end=3))
    windows = draw(replay, 20_000, 2, 3)
    assert int(windows.lead.min()) == 3
    complete = [t for t in transitions if t.obs[0] <= t.obs[1] - 3]
    drawn = set(np.asarray(windows.action[:, 2, 0]).tolist())
    unfinished = {float(t.action[0]) for t in transitions[-10:] if not transitions[-1].done}
    assert {float(t.action[0]) for t in complete} - unfinished <= drawn
    assert drawn <= {float(t.action[0]) for t in complete}


def test_windows_are_whole_when_the_ring_closes() -> None:
    """Steps that start Δ rows into their episode: the rows before them are overwritten before any step is."""
    delay, capacity = 4, 40
    transitions, _ = record(TASK, delay, 60)
    replay, whole = ring.init(Spec(2, 1, delay), capacity), 0
    for transition in transitions:
        replay = append(replay, transition, ring.Learnable(first=delay))
        if int(replay.rows) >= capacity:
            windows = draw(replay, 500, delay, 1)
            assert windows.valid[:, : delay + 1].all()
            whole += int(replay.lost) == 0
    assert whole > 2


def test_round_trip() -> None:
    """What the wrapper showed is what `view` makes of the replay, at every step and every shorter delay."""
    for delay in (0, 1, 4, 9):
        replay, transitions, shown = filled(150, delay, 400)
        windows = draw(replay, 3000, delay, 3)
        by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
        for shorter in {None, 0, delay // 2}:
            views = jax.device_get(jax.jit(jax.vmap(lambda w, shorter=shorter: view(w, 0, shorter)))(windows))
            for i, action in enumerate(np.asarray(windows.action[:, delay, 0]).tolist()):
                step = by_action[action]
                known = shown[step]
                if shorter is None:
                    np.testing.assert_array_equal(views.obs[i], known.obs)
                    np.testing.assert_array_equal(views.actions[i], known.actions)
                    assert int(views.age[i]) == known.age
                else:
                    age = min(int(known.age), shorter)
                    np.testing.assert_array_equal(views.obs[i], transitions[step - age].obs)
                    actions = [t.action for t in transitions[step - age : step]]
                    np.testing.assert_array_equal(views.actions[i][:age], np.reshape(actions, (age, 1)))


def test_view_ahead_is_the_next_view() -> None:
    """The view at t + k is what the wrapper showed k steps later (also after the last action of an episode)."""
    delay = 4
    replay, transitions, shown = filled(150, delay, 400)
    windows = draw(replay, 500, delay, 3)
    views = jax.device_get(jax.jit(jax.vmap(lambda w: view(w, w.n_step)))(windows))
    by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
    checked = 0
    for i, action in enumerate(np.asarray(windows.action[:, delay, 0]).tolist()):
        later = by_action[action] + int(windows.n_step[i])
        if later < len(shown) and not transitions[later - 1].done:
            np.testing.assert_array_equal(views.obs[i], shown[later].obs)
            np.testing.assert_array_equal(views.actions[i], shown[later].actions)
            checked += 1
        elif later <= len(transitions) and transitions[later - 1].done:
            age = min(int(transitions[later - 1].next_obs[0]), delay)
            np.testing.assert_array_equal(views.obs[i], transitions[later - age].obs)
            checked += 1
    assert checked > 450


@pytest.mark.parametrize("hidden", [0, 1, 3])
def test_hidden_observations_are_never_given(hidden: int) -> None:
    """An unprivileged learner of age `hidden` finds nothing of the newest `hidden` observations in any window."""
    delay = 3
    transitions, _ = record(TASK, delay, 200)
    while transitions[-1].next_obs[0] < 3 or transitions[-1].done:
        transitions.pop()
    marks = np.float32([[i, 0] for i in range(len(transitions) + 1)])  # observations named by the step that follows
    marked = [t._replace(obs=marks[i], next_obs=marks[i + 1]) for i, t in enumerate(transitions)]
    replay = replay_of(marked, Spec(2, 1, delay), 400)
    windows = draw(replay, 5000, delay, 3, hidden)
    newest = len(transitions) - hidden
    assert int(windows.obs[..., 0].max()) == newest
    assert int((windows.valid * windows.obs[..., 0]).max()) == newest
    assert int(windows.lead.min()) == int(windows.n_step.min()) == 1  # the outcome of each has arrived


def test_of_finished_episodes_nothing_is_hidden() -> None:
    """Where an episode's first Δ steps are not learned from, fewer steps are hidden than observations."""
    delay, learnable = 3, ring.Learnable(first=3)
    transitions, _ = record(TASK, delay, 120)
    while transitions[-1].done or transitions[-1].next_obs[0] != 4:  # one step of the current episode counts
        transitions.pop()
    replay = replay_of(transitions, Spec(2, 1, delay), 400, learnable)
    counts = [int(ring.drawable(replay, hidden, learnable)) for hidden in (0, 1, 3)]
    assert counts == [int(replay.steps), int(replay.steps) - 1, int(replay.steps) - 1]
    windows = sample(replay, jax.random.key(0), 5000, delay, 1, jnp.int32(3), learnable)
    drawn = set(np.asarray(windows.action[:, delay, 0]).tolist())
    start = len(transitions) - 4
    assert drawn == {float(t.action[0]) for t in transitions[:start] if t.obs[0] >= 3}


def test_memory_of_humanoid() -> None:
    """A million steps of Humanoid take at most 1.7 GB, whatever Δ is."""
    for delay in (0, 50):
        shapes = jax.eval_shape(lambda delay=delay: ring.init(Spec(376, 17, delay), 1_000_000))
        total = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
        assert total <= 1.7e9
