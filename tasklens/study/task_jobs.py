"""Settings of the jobs of tasks other than classification, and contents of their table; no torch here."""

from typing import Any, NamedTuple

from tasklens.settings.base import Frozen
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.names import SHARP
from tasklens.settings.task_settings import TaskSettings
from tasklens.study.job_settings import lens_columns
from tasklens.study.study import Study, StudyError
from tasklens.study.table_contents import LensKey, chosen_lenses


class TaskFineTuningJob(Frozen):
    """Fine-tuning of the network of a task on the captures of a lens (None: sharp images), and its scores."""

    name: str
    network: TaskSettings
    capture: CaptureSettings | None
    columns: dict[str, Any]
    seed: int

    @classmethod
    def of(cls, study: Study, lens: str, task: str, seed: int) -> "TaskFineTuningJob":
        """Return the settings of the job."""
        capture = None if lens == SHARP else study.capture_of(lens)
        columns = lens_columns(study, lens) | {"task": task, "seed": seed}
        return cls(name=task, network=study.task(task), capture=capture, columns=columns, seed=seed)


class TaskKey(NamedTuple):
    """Wildcards of the files of a score; `lens` may be SHARP."""

    lens: str
    task: str
    seed: int


class TaskContents(Frozen):
    """Contents of the table of tasks other than classification.

    Attributes:
        study: name of the study.
        lenses, tasks, seeds: names and seeds of its rows; the sharp images come first.
    """

    study: str
    lenses: tuple[str, ...]
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]

    @property
    def score_keys(self) -> list[TaskKey]:
        """All scores."""
        return [TaskKey(lens, task, seed) for lens in self.lenses for task in self.tasks for seed in self.seeds]

    @property
    def drawn(self) -> list[str]:
        """Lenses whose PSFs are drawn."""
        return [lens for lens in self.lenses if lens != SHARP]

    @property
    def drawn_keys(self) -> list[LensKey]:
        """These lenses in the first seed."""
        return [LensKey(lens, self.seeds[0]) for lens in self.drawn]


def tasks(study: Study) -> TaskContents:
    """Return the contents of the table of tasks; raises StudyError if there are no tasks."""
    if not study.tasks.networks:
        raise StudyError("tasks.networks: expected a task, such as segmentation: {kind: segmentation, model: ...}")
    chosen = chosen_lenses(study, study.tasks.designs)
    own: list[str] = []
    if study.tasks.designs is None:  # table 1 has none of them
        own = [lens.name for lens in study.lenses.values() if lens.design.task]
    return TaskContents(
        study=study.name, lenses=(SHARP, *chosen, *own), tasks=tuple(study.tasks.networks), seeds=study.seeds
    )
