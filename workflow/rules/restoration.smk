"""Restoration of captures."""


rule restore:
    """Train the restoration network on the captures of a lens."""
    input:
        train=TRAIN,
        minival=MINIVAL,
        psf=psf,
    output:
        weights="results/{study}/restoration/{lens}/seed{seed}/nafnet.safetensors",
        history="results/{study}/restoration/{lens}/seed{seed}/history.csv",
    log:
        "results/{study}/logs/restore/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/restore/{lens}-seed{seed}.tsv"
    priority: 0.5  # fine-tuning on restored captures, an equally long job, waits for it
    resources:
        **needs("restore", gpu=1),
    params:
        **call("tasklens.study.jobs.restore.run"),
        settings=named(
            restoration=lambda study: study.restoration,
            capture=lambda study, lens: study.capture_of(lens),
            seed=lambda study, seed: seed,
        ),
    script:
        "../scripts/job.py"
