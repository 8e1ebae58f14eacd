"""The training loop of one stage: several processes, resumable, for a number of steps or of minutes."""

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from tqdm import tqdm

from cadam3d.io.atomic import replacing

# Processes train alone for this many steps, then take the mean of their parameters (local SGD, Stich 2019).
AVERAGE_EVERY = 8  # steps
WARM_UP = 100  # steps
# The learning rate ends at this share of its peak.
LAST_RATE = 0.03
SAVE_EVERY = 90.0  # seconds
LOG_EVERY = 50  # steps
# The largest weight of the past in the moving average of the parameters, which is what is kept in the end.
AVERAGE_DECAY = 0.98  # per AVERAGE_EVERY steps
BAR = "{desc}: {percentage:3.0f} %|{bar}| {elapsed}<{remaining}{postfix}"


@dataclass(frozen=True)
class Workers:
    """This process among those that train together."""

    rank: int
    count: int
    device: torch.device

    @classmethod
    def join(cls, rank: int, count: int, device: str, rendezvous: Path) -> "Workers":
        """Join the group of ``count`` processes that share the file ``rendezvous``."""
        if device == "cpu":
            torch.set_num_threads(max(1, (os.cpu_count() or 1) // count))
        if count > 1:
            dist.init_process_group("gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=count)
        return cls(rank, count, torch.device(device))

    @property
    def leads(self) -> bool:
        """Return whether this process writes files."""
        return self.rank == 0

    def leave(self) -> None:
        """Leave the group."""
        if self.count > 1:
            dist.destroy_process_group()

    def average(self, tensors: list[Tensor]) -> None:
        """Replace tensors by their means over all processes."""
        if self.count == 1:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(flat)
        flat /= self.count
        for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def agreed(self, number: float) -> float:
        """Return the number of the first process."""
        if self.count == 1:
            return number
        shared = torch.tensor([number], dtype=torch.float64)
        dist.broadcast(shared, 0)
        return float(shared)

    def wait(self) -> None:
        """Wait for all processes."""
        if self.count > 1:
            dist.barrier()


@dataclass(frozen=True)
class Budget:
    """How long a stage trains: a number of steps, or of minutes."""

    steps: int | None
    minutes: float | None

    def progress(self, step: int, seconds: float) -> float:
        """Return the share of the budget that is spent, in [0, 1]."""
        share = step / self.steps if self.steps is not None else seconds / (60 * (self.minutes or 1e-9))
        return min(1.0, share)


@dataclass(frozen=True)
class Stage:
    """What one stage trains."""

    name: str
    model: nn.Module
    # From the random generator of one step to the loss.
    loss: Callable[[torch.Generator], Tensor]
    # Figures on held-out data, of the model as it is.
    evaluate: Callable[[], Mapping[str, Any]]
    rate: float  # the peak of the learning rate
    budget: Budget
    seed: int


def run(stage: Stage, workers: Workers, folder: Path) -> None:
    """Train, or continue from the checkpoint in ``folder``; the model ends with its averaged parameters."""
    checkpoint = folder / f"{stage.name}.pt"
    parameters = [p for p in stage.model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(parameters, lr=stage.rate, betas=(0.9, 0.99), weight_decay=0.0)
    smooth = [p.detach().clone() for p in parameters]
    step, spent, done = 0, 0.0, False
    if checkpoint.is_file():
        kept = torch.load(checkpoint, map_location=workers.device, weights_only=True)
        stage.model.load_state_dict(kept["model"])
        optimizer.load_state_dict(kept["optimizer"])
        smooth, step, spent, done = kept["smooth"], kept["step"], kept["seconds"], kept["done"]
    workers.wait()
    was_done = done
    begin = last_save = time.monotonic()
    progress, mean_loss = (1.0 if done else stage.budget.progress(step, spent)), None
    bar = tqdm(total=1000, desc=stage.name, disable=not workers.leads, bar_format=BAR)
    bar.update(int(1000 * progress))
    while not done:
        for group in optimizer.param_groups:
            group["lr"] = stage.rate * rate_at(step, progress)
        generator = torch.Generator().manual_seed(_seed(stage.seed, workers.rank, step))
        loss = stage.loss(generator)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        step += 1
        mean_loss = loss.item() if mean_loss is None else mean_loss + 0.01 * (loss.item() - mean_loss)
        if step % LOG_EVERY == 0 and workers.leads:
            _log(folder, stage.name, step=step, seconds=spent + time.monotonic() - begin, loss=mean_loss)
        if step % AVERAGE_EVERY:
            continue
        workers.average([p.data for p in parameters])
        decay = min(AVERAGE_DECAY, (1 + step / AVERAGE_EVERY) / (10 + step / AVERAGE_EVERY))
        for average, parameter in zip(smooth, parameters, strict=True):
            average.lerp_(parameter.data, 1 - decay)
        seconds = spent + time.monotonic() - begin
        progress = workers.agreed(stage.budget.progress(step, seconds))
        done = progress >= 1
        bar.n = int(1000 * progress)
        bar.set_postfix_str(f"step {step}, loss {mean_loss:.4f}")
        due = time.monotonic() - last_save > SAVE_EVERY
        if workers.leads and (done or due):
            _save(checkpoint, stage.model, optimizer, smooth, step, seconds, done)
            last_save = time.monotonic()
    bar.close()
    for average, parameter in zip(smooth, parameters, strict=True):
        parameter.data.copy_(average)
    if workers.leads and not was_done:
        _log(folder, stage.name, step=step, seconds=spent + time.monotonic() - begin, **stage.evaluate())
    workers.wait()


def rate_at(step: int, progress: float) -> float:
    """Return the factor of the learning rate, in (0, 1]: a short rise, then half a cosine.

    ``progress`` is the share of the budget that is spent, in [0, 1].
    """
    cosine = 0.5 * (1 + math.cos(math.pi * progress))
    return min(1.0, (step + 1) / WARM_UP) * (LAST_RATE + (1 - LAST_RATE) * cosine)


def _seed(seed: int, rank: int, step: int) -> int:
    return (seed * 1000 + rank) * 100_000_000 + step


def _save(
    path: Path,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    smooth: list[Tensor],
    step: int,
    seconds: float,
    done: bool,
) -> None:
    state = {
        "model": model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "smooth": smooth,
        "step": step,
        "seconds": seconds,
        "done": done,
    }
    with replacing(path) as temporary:
        torch.save(state, temporary)


def _log(folder: Path, stage: str, **figures: Any) -> None:
    rounded = {key: round(value, 5) if isinstance(value, float) else value for key, value in figures.items()}
    with (folder / "curves.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({"stage": stage, **rounded}) + "\n")
