"""Random delay laws, channels and delays, for hypothesis."""

import numpy as np
from hypothesis import strategies as st

from delayrl.delays import (
    Channel,
    Choice,
    Constant,
    Delay,
    PerEpisode,
    Recorded,
    gamma,
    gilbert_elliott,
    poisson,
    random_walk,
    uniform,
)
from delayrl.delays.own import own_law
from own_laws import Burst

str(own_law(Burst()))  # the first one reads what is installed, which takes longer than an example may
STEPS = st.integers(0, 6)
CHANCE = st.floats(0.01, 0.99)


@st.composite
def choices(draw: st.DrawFn) -> Choice:
    steps = draw(st.lists(STEPS, min_size=1, max_size=4, unique=True))
    weights = np.array(draw(st.lists(st.integers(1, 9), min_size=len(steps), max_size=len(steps))))
    return Choice(tuple(steps), tuple((weights / weights.sum()).tolist()))


EPISODES = st.one_of(
    choices().map(PerEpisode),
    st.builds(gilbert_elliott, STEPS, STEPS, CHANCE, CHANCE).map(PerEpisode),
)
LAWS = st.one_of(
    STEPS.map(Constant),
    choices(),
    st.tuples(STEPS, STEPS).map(lambda pair: uniform(min(pair), max(pair))),
    st.builds(poisson, st.floats(0.2, 5), STEPS),
    st.builds(gamma, st.floats(0.5, 4), st.floats(0.2, 3), st.integers(2, 6)),
    st.builds(gilbert_elliott, STEPS, STEPS, CHANCE, CHANCE),
    st.builds(random_walk, STEPS, CHANCE),
    st.lists(STEPS, min_size=1, max_size=60).map(lambda steps: Recorded(tuple(steps))),
    EPISODES,
    st.builds(Burst, CHANCE, STEPS, st.integers(1, 3)).map(own_law),
)
CHANNELS = st.builds(Channel, LAWS, st.sampled_from(["newest", "fifo", "raw", "wait"]))
ORDERED = st.builds(Channel, LAWS, st.sampled_from(["newest", "fifo", "wait"]))
DELAYS = st.builds(Delay, CHANNELS, st.one_of(st.just(Channel()), CHANNELS), st.one_of(st.just(Channel()), ORDERED))
