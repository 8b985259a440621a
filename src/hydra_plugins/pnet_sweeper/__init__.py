"""How pnet's commands run several jobs: the classes that Hydra loads, which it does from this package only.

They stay light, because Hydra imports them at every start; what they do is in `pnet.cli`.
"""

from collections.abc import Sequence
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class ResumingSweeper(Sweeper):
    """Runs the jobs of `--multirun` that are not done: those of a file in `sweeps/`, or all combinations."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra before `sweep`."""
        from hydra.core.plugins import Plugins

        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        """Run what is missing; exit code 1 where a job failed."""
        from pnet.cli.sweep import sweep

        assert self.launcher is not None
        return sweep(arguments, self.launcher)


class ProcessLauncher(Launcher):
    """Each job in a process of its own, one after another."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra before `launch`."""
        self.config = config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the jobs; a failed one does not stop the others."""
        from pnet.cli.launch import run_one_by_one

        hydra_overrides = [str(word) for word in self.config.hydra.overrides.hydra]
        return run_one_by_one(self.config.hydra.job.config_name, hydra_overrides, job_overrides)
