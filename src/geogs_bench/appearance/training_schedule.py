"""Schedule of the training, by the elapsed fraction of the time budget."""

from dataclasses import dataclass

from geogs_bench.appearance.appearance_config import AppearanceConfig


@dataclass(frozen=True)
class Schedule:
    """The public schedule stretched over ``budget`` seconds."""

    config: AppearanceConfig
    budget: float
    """Seconds."""

    def step(self, elapsed: float) -> float:
        """Step of the public schedule that corresponds to ``elapsed`` seconds."""
        return self.config.steps * elapsed / self.budget

    def sh_degree(self, step: float) -> int:
        """Highest degree of the spherical harmonics in use."""
        return min(int(step // self.config.sh_interval), self.config.sh_degree)

    def means_rate(self, step: float, scene_scale: float) -> float:
        """Learning rate of positions, units of the poses."""
        part = min(step / self.config.steps, 1.0)
        return self.config.means_rate * scene_scale * self.config.means_decay**part

    def uses_normals(self, step: float) -> bool:
        """Whether the consistency of normals counts."""
        return self.config.normal_weight > 0 and step > self.config.normal_start


class RefinementClock:
    """Decides when disks are added and removed."""

    def __init__(self, config: AppearanceConfig) -> None:
        self._config = config
        self._step = float(config.refine_start)
        self._iteration = 0

    def gathers(self, step: float) -> bool:
        """Whether image gradients are still used."""
        return step < self._config.refine_stop

    def is_due(self, step: float, iteration: int) -> bool:
        """Whether to refine now; if so, the next interval begins now."""
        config = self._config
        due = (
            self.gathers(step)
            and step - self._step >= config.refine_every
            and iteration - self._iteration >= config.refine_iterations
        )
        if due:
            self._step, self._iteration = step, iteration
        return due
