"""Measure a delay: of an environment, by pushing it (`probe`); of a running system, from its log (`from_log`).

Both need NumPy and Gymnasium alone; matplotlib is imported for a plot, pyarrow for a Parquet file.
"""

from delayrl.measure.log import Estimated as Estimated
from delayrl.measure.log import from_log as from_log
from delayrl.measure.probing import Probed as Probed
from delayrl.measure.probing import probe as probe
