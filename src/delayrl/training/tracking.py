"""Optional logging of scalars to TensorBoard or Weights & Biases. The run folder always has them."""

from collections.abc import Callable
from pathlib import Path

SERVICES = {"tensorboard": "tensorboardX", "wandb": "wandb"}
"""Where metrics can be logged besides, and the module that this takes."""


class Tracker:
    """Writes scalars to one service from a step on; with `kind` None to nowhere."""

    def __init__(self, kind: str | None, path: Path, step: int):
        self.write: Callable[[int, dict[str, float]], object] = lambda step, values: None
        self.close: Callable[[], object] = lambda: None
        if kind == "tensorboard":
            from tensorboardX import SummaryWriter

            # a stopped run may have been further; what it logged at `step` itself stays
            writer = SummaryWriter(str(path / "tensorboard"), purge_step=step + 1)
            self.close = writer.close
            self.write = lambda step, values: [writer.add_scalar(k, v, step) for k, v in values.items()]
        elif kind == "wandb":
            import wandb

            run = wandb.init(project="delayrl", name=str(path), dir=str(path), reinit="create_new")
            self.close = run.finish
            self.write = lambda step, values: run.log(values, step=step)
