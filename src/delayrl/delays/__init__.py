"""Laws of travel times, channels with arrival rules, and the text form of both. Needs NumPy alone."""

from delayrl.delays.channels import PAPER_STOCHASTIC_5 as PAPER_STOCHASTIC_5
from delayrl.delays.channels import Channel as Channel
from delayrl.delays.channels import Delay as Delay
from delayrl.delays.channels import Rule as Rule
from delayrl.delays.channels import short_label as short_label
from delayrl.delays.episodes import PerEpisode as PerEpisode
from delayrl.delays.episodes import any_phase as any_phase
from delayrl.delays.episodes import unsynchronised as unsynchronised
from delayrl.delays.laws import Choice as Choice
from delayrl.delays.laws import Constant as Constant
from delayrl.delays.laws import DelayLaw as DelayLaw
from delayrl.delays.laws import Markov as Markov
from delayrl.delays.laws import Recorded as Recorded
from delayrl.delays.laws import gamma as gamma
from delayrl.delays.laws import gilbert_elliott as gilbert_elliott
from delayrl.delays.laws import poisson as poisson
from delayrl.delays.laws import random_walk as random_walk
from delayrl.delays.laws import uniform as uniform
from delayrl.delays.recordings import recorded as recorded
from delayrl.delays.text import DelayLike as DelayLike
from delayrl.delays.text import as_delay as as_delay
from delayrl.delays.text import stored_delay as stored_delay
from delayrl.delays.units import in_other_unit as in_other_unit
