"""What the rules read, where it depends on the wildcards."""

PICTURES = [layout.images(split) for split in ("train", "minival", "test")]
VERIFIED = jobs.verify(study)


def published_weights(wildcards):
    """The local file that a classifier starts from, if its study names one."""
    path = study.classifiers[wildcards.classifier].weights
    return [] if path is None else str(path)


def processes(wildcards):
    """How many processes fine-tune a classifier together."""
    return study.classifiers[wildcards.classifier].processes


def tasklens_of(wildcards):
    """The command line, once for every process."""
    count = processes(wildcards)
    # Snakemake sets the threads of a job to its cores, here those of all its processes.
    team = f"OMP_NUM_THREADS=1 torchrun --standalone --nproc-per-node {count} -m tasklens.pipeline.cli"
    return "tasklens" if count == 1 else team


def design_inputs(wildcards):
    """What a design reads: pictures and the supervisor, imaging lenses to start from, a lens from outside, or nothing."""
    inputs = {}
    job = jobs.design(study, wildcards.lens, wildcards.seed)
    if job.classifier is not None:
        inputs["pictures"] = layout.images("train")
        inputs["weights"] = layout.reference(study.supervisor)
    if isinstance(job.lens.design, Outside):
        inputs["files"] = [str(path) for path in (job.lens.design.file, *job.lens.design.catalogues)]
    rivals = jobs.imaging_rivals(study, wildcards.lens)
    if rivals:
        inputs["rivals"] = [layout.lens(name, wildcards.seed) for name in rivals]
        inputs["judged"] = [layout.metrics(name, wildcards.seed, study.supervisor) for name in rivals]
    return inputs


def seen_through(wildcards):
    """The PSF grid of a lens; nothing for a classifier that sees the pictures themselves."""
    return [] if wildcards.lens == SHARP else layout.psf(wildcards.lens, wildcards.seed)


def table_inputs(wildcards):
    """The lenses of a table, and the metrics of its classifiers on them and on the pictures themselves."""
    job = jobs.table(study, wildcards.table)
    return {
        "lenses": [layout.lens(lens, seed) for lens in job.lenses for seed in job.seeds],
        "metrics": [layout.metrics(lens, seed, classifier) for lens, classifier in job.measured for seed in job.seeds],
    }


def opposed(job):
    """The lenses that claims are about, their rivals, and what the supervisor recognised through them."""
    lenses = list(dict.fromkeys(name for claim in job.claims for name in (claim.lens, *claim.rivals)))
    pairs = [(lens, seed) for lens in lenses for seed in study.seeds]
    return {
        "lenses": [layout.lens(*pair) for pair in pairs],
        "metrics": [layout.metrics(*pair, study.supervisor) for pair in pairs],
        "pictures": [layout.pictures(*pair, study.supervisor) for pair in pairs],
    }


def varied(wildcards):
    """What an ablation compares."""
    return opposed(claims.ablation(study, wildcards.ablation).verdicts)


def beside(wildcards):
    """The task-driven lens of some elements and all its imaging rivals, with what the supervisor made of them."""
    claim = claims.over_imaging(study, wildcards.elements)
    lenses = (claim.lens, *claim.rivals)
    return {
        "lenses": [layout.lens(lens, wildcards.seed) for lens in lenses],
        "psf": [layout.psf(lens, wildcards.seed) for lens in lenses],
        "metrics": [layout.metrics(lens, wildcards.seed, claim.classifier) for lens in lenses],
    }


def measured(wildcards):
    """All lenses, and all that the tables show: metrics, and the pictures that were recognised."""
    pairs = [(lens, seed, classifier) for lens, classifier in VERIFIED.measured for seed in study.seeds]
    return {
        "lenses": [layout.lens(lens, seed) for lens in study.lenses for seed in study.seeds],
        "metrics": [layout.metrics(*names) for names in pairs],
        "pictures": [layout.pictures(*names) for names in pairs],
    }
