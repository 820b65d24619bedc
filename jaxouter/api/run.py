"""A trained run: its policy, evaluation, figures and exports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from jaxouter.evaluation import policies, scenarios
from jaxouter.evaluation.cache import use_compilation_cache
from jaxouter.evaluation.policies import NamedPolicy, Results, TrainingSummary
from jaxouter.exports import files
from jaxouter.exports.spec import ControllerSpec
from jaxouter.plants import Ranges, base
from jaxouter.plants.registry import Maker, own_errors
from jaxouter.progress import Progress, showing
from jaxouter.runtime import Controller
from jaxouter.training.config import TrainConfig
from jaxouter.training.epochs import Row
from jaxouter.training.policy import LearnedPolicy
from jaxouter.training.run import RunFolder, add_agent, add_plant, open_run

if TYPE_CHECKING:
    from jaxouter.evaluation.drawing import Figure


@dataclass(frozen=True, repr=False)
class RunPolicy(NamedPolicy):
    """The learned policy of a run, without exploration: `init(r0, y0)`, `act(carry, r, y)`."""

    policy: LearnedPolicy
    spec: ControllerSpec

    def controller(self, **settings: Any) -> Controller:
        """A controller in NumPy for a real loop: `step(r, y)` gives r~.

        Args:
            **settings: see `jaxouter.runtime.Controller`.
        """
        return Controller(self.spec, **settings)


class Run:
    """A trained run, as `jaxouter.learn` and `jaxouter.load` give it."""

    def __init__(self, folder: RunFolder, seed: int | None = None) -> None:
        """Args: folder: of the run; seed: one of the run's; None: its median seed."""
        self._folder = folder
        self.seed = folder.median_seed() if seed is None else seed
        """The seed whose policy this is."""

    def __repr__(self) -> str:
        return f"<jaxouter.Run of {self.config.plant}, preset {self.config.preset}, seed {self.seed}: {self.path}>"

    @property
    def path(self) -> Path:
        """The run folder."""
        return self._folder.path

    @property
    def config(self) -> TrainConfig:
        """The configuration of the training."""
        return self._folder.config

    @property
    def seeds(self) -> tuple[int, ...]:
        """All seeds of the run."""
        return tuple(self._folder.seeds)

    @property
    def drawn(self) -> tuple[str, Ranges, float]:
        """See `RunFolder.drawn`."""
        return self._folder.drawn

    def of_seed(self, seed: int) -> Run:
        """The same run, with the policy of another seed.

        Raises:
            ValueError: the run has no such seed.
        """
        if seed not in self.seeds:
            raise ValueError(f"seed is {seed}; {self.path} has: {', '.join(map(str, self.seeds))}")
        return Run(self._folder, seed)

    @cached_property
    def policy(self) -> RunPolicy:
        """The learned policy of the seed.

        Raises:
            ValueError: there is no readable checkpoint.
        """
        with own_errors():
            policy, params = self._folder.policy(self.seed)
            spec = ControllerSpec.of(policy, params, self._folder.trainer[0].env.plant)
        return RunPolicy("learned", policy, params, self.config.plant, spec)

    @property
    def metrics(self) -> list[Row]:
        """Rows of metrics.jsonl of the seed, one per epoch."""
        return self._folder.rows(self.seed)

    @property
    def summary(self) -> TrainingSummary | None:
        """Figures of merit of all seeds and of the simplest baselines; None if the run was not evaluated.

        Raises:
            ValueError: summary.json is damaged.
        """
        path = self.path / "summary.json"
        if not path.exists():
            return None
        try:
            return msgspec.json.decode(path.read_bytes(), type=TrainingSummary)
        except msgspec.DecodeError as error:
            raise ValueError(f"{path} is damaged: {error}") from None

    def evaluate(
        self,
        scenario: str | Sequence[str] = (),
        *,
        set: Mapping[str, Any] | None = None,
        episodes: int | None = None,
        family_seed: int = scenarios.FAMILY_SEED,
        progress: bool | Progress = True,
    ) -> Results:
        """Evaluate the policy on scenarios that training never saw; see `jaxouter.evaluation.evaluate`.

        For example: `run.evaluate("paper")["pitch/paper"].figures.mae`.
        """
        use_compilation_cache()
        return policies.evaluate(
            self.policy, None, scenario, set=set, episodes=episodes, family_seed=family_seed, progress=progress
        )

    def plot(self, scenario: str | None = None, path: Path | str | None = None) -> Figure:
        """Draw r, y and r~ over time, with the outer loop beside without it; a notebook shows the figure.

        Args:
            scenario: id, such as `pitch/paper` or `paper`; None: the first of those that a training reports.
            path: file to write, in the format of its suffix; None: none.

        Returns:
            A matplotlib figure, made without pyplot.

        Raises:
            ValueError: there is no such scenario.
        """
        wanted = scenario or scenarios.reported(self.config.plant)[0]
        (identifier, found), *_ = self.evaluate(wanted, episodes=1, progress=False).items()
        alone = policies.evaluate("none", self.config.plant, identifier, episodes=1, progress=False)
        from jaxouter.evaluation import figures  # matplotlib takes two seconds, also where nothing is drawn

        of = ({identifier: each.traces} for each in (alone[identifier], found))
        figure = figures.response([scenarios.get(identifier, 1)], *of)
        if path is not None:
            figures.save(figure, Path(path))
        return figure

    def export(self, path: Path | str, *, force: bool = False, progress: bool | Progress = True) -> str:
        """Write the controller to a file in the format that its suffix names: .onnx, .npz, .stablehlo, .c or .fmu.

        Args:
            path: new file; .c also makes a .h.
            force: even if the run found its policy worse than r~ = r or the static prefilter.
            progress: whether to show progress.

        Returns:
            How far the file deviates from the policy, in one line.

        Raises:
            ValueError: the file exists, or can't be made here; or the policy is worse.
            ArithmeticError: the file differs from the policy; it is not written.
        """
        path = Path(path)
        files.check(path)
        verdict = self._folder.verdict()
        if self.seed in verdict.get("worse", ()) and not force:
            raise ValueError(f"{self.path}, seed {self.seed}: {verdict['text']}")
        use_compilation_cache()
        of = self.policy
        with own_errors(), showing(progress) as progress:
            return files.export(of.spec, of.policy, of.params, path, progress)


def load(path: Path | str, *, plant: str | Maker | None = None, agent: str | None = None) -> Run:
    """Load a run.

    Args:
        path: run folder (its median seed is taken), or the folder of one seed in it.
        plant: the run's plant, if your own, as for `jaxouter.learn`. A run folder never causes code to be imported.
        agent: the run's agent, if your own: FILE.py:CLASS.

    Raises:
        ValueError: the folder is not a run, or the plant or agent is another one.
    """
    path = Path(path)
    add_agent(agent)
    named = None if plant is None else add_plant(plant, path)
    folder, seed, _ = open_run(path)
    if named not in (None, folder.config.plant, base(folder.config.plant)):
        raise ValueError(f"{path} is a run on {folder.config.plant}, not on {named}")
    return Run(folder, seed)
