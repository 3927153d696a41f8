"""Measure delays: `probe` that of an environment by changing actions, `from_log` that of a running system.

Both need only NumPy and Gymnasium. Plots need matplotlib, and Parquet files pyarrow.
"""

from delayrl.measure.estimated import Estimated as Estimated
from delayrl.measure.log import from_log as from_log
from delayrl.measure.probing import Probed as Probed
from delayrl.measure.probing import probe as probe
