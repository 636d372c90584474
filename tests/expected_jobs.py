"""The jobs that a study implies, counted from its lenses, classifiers and tables instead of from the rules."""

from tasklens.settings.starts import best_of, imaging_designs
from tasklens.study.loading import parts
from tasklens.study.study import Study

PAGE_JOBS = ("psf_tail_table", "effort_table", "captures", "report_page")


def by_network(lens) -> list:
    """The descents of a lens on the loss of a network."""
    return [descent for descent in getattr(lens.design, "descents", ()) if descent.criterion == "task"]


def task_driven(lens) -> bool:
    """True if the network is frozen at first, or trained with a lens that is chosen from a list."""
    descents = by_network(lens)
    return bool(descents) and (descents[0].network_learning_rate is None or isinstance(lens.design.start, tuple))


class Expected:
    """Jobs counted from a study, by what the paper's tables are about."""

    def __init__(self, study: Study):
        self.study = study
        self.shown: set[str] = set()  # lenses in the tables of the study
        self.measured: set[tuple[str, str, bool]] = set()  # lens, classifier, restored or not
        self.waiting: set[str] = set()  # further lenses that are designed: those to start from
        for table in study.tables:
            lenses = [lens for lens in study.lenses.values() if self._is_in(table, lens)]
            classifiers = study.classifiers if table == "table2" else [study.supervisor]
            self.shown |= {lens.name for lens in lenses}
            self.measured |= {("sharp", classifier, False) for classifier in classifiers}
            self.measured |= {(lens.name, c, table == "table4") for lens in lenses for c in classifiers}
            self.add_starts(lenses)

    def _is_in(self, table: str, lens) -> bool:
        if getattr(lens.design, "task", None):  # shown in the table of its task
            return False
        if table == "table4" and self.study.restored is not None and lens.elements not in self.study.restored:
            return False
        return bool(by_network(lens)) if table == "table3" else task_driven(lens) or not by_network(lens)

    def add_starts(self, lenses) -> None:
        for lens in lenses:
            start, named = getattr(lens.design, "start", None), ()
            if start in ("best_imaging", "best_spot"):
                named = best_of(self.study.designs)[start]
            elif isinstance(start, tuple) and lens.design.descents[-1].network_learning_rate:
                named = start
            if named:
                starts = {f"{lens.elements}-{name}" for name in named}
                self.waiting |= starts
                self.measured |= {(name, self.study.supervisor, False) for name in starts}

    @property
    def designed(self) -> set[str]:
        return self.shown | self.waiting

    def counts(self, *seedless: tuple[str, int], **others: int) -> dict[str, int]:
        """Jobs of these lenses and measurements; the numbers of `others` are per seed."""
        supervised = [self.study.lens(name) for name in self.designed]
        needed = {classifier for _, classifier, _ in self.measured}
        if any(map(by_network, supervised)):
            needed |= {self.study.supervisor}
        by_seed = {
            "design": len(self.designed),
            "psfs": len(self.designed),
            "fine_tune": len(self.measured),
            "restore": len({lens for lens, _, restored in self.measured if restored}),
            **others,
        }
        counts = {name: count * len(self.study.seeds) for name, count in by_seed.items()}
        early = len(parts(self.study))
        counts |= {"images": 1, "reference": len(needed), "table": len(self.study.tables) + early, **dict(seedless)}
        counts |= dict.fromkeys(("verdicts_table", *PAGE_JOBS), 1 + early)
        return {name: count for name, count in counts.items() if count}


def expected(study: Study) -> dict[str, int]:
    """Jobs of the target `tables`."""
    jobs = Expected(study)
    return jobs.counts(("certificate", len(jobs.shown)))  # of the first seed, for the report


def expected_of_everything(study: Study) -> dict[str, int]:
    """Jobs of all tables, figures, certificates and ablations, and of the verification of the tables."""
    jobs = Expected(study)
    again = len(jobs.measured - {(name, study.supervisor, False) for name in jobs.waiting - jobs.shown})
    drawn = {lens.elements for lens in study.lenses.values() if task_driven(lens)}
    jobs.measured |= {  # the best imaging lens stands beside the task-driven one
        (f"{elements}-{name}", study.supervisor, False) for elements in drawn for name in imaging_designs(study.designs)
    }
    jobs.waiting |= set(study.lenses)
    for name, item in study.ablations.items():
        designs = [item.design, *(item.name(name, variant) for variant in item.variants)]
        lenses = [f"{item.elements}-{design}" for design in designs]
        jobs.waiting |= set(lenses)
        jobs.measured |= {(lens, study.supervisor, False) for lens in lenses}
        jobs.add_starts([study.lens(lens) for lens in lenses])
    every = len(study.lenses)
    per_seed = {
        "certificate": every,
        "drawing": every,
        "comparison": len(drawn),
        "frames": len(drawn),
        "reproduce": again,
    }
    return jobs.counts(("ablation", len(study.ablations)), **per_seed)
