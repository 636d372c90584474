"""Accuracies of classifiers on the captures of lenses."""


rule fine_tune:
    """Fine-tune a classifier on the captures of a lens, and measure it at every field; also its loss before that."""
    input:
        train=TRAIN,
        minival=MINIVAL,
        test=TEST,
        psf=psf,
        restoration=branch(lambda w: names.split(w.measured_name)[1], then=rules.restore.output.weights),
        reference=sharp_weights,
    output:
        weights="results/{study}/classifiers/{lens}/seed{seed}/{measured_name}.safetensors",
        metrics="results/{study}/metrics/{lens}/seed{seed}/{measured_name}.csv",
        predictions="results/{study}/metrics/{lens}/seed{seed}/{measured_name}-predictions.csv",
        frozen="results/{study}/metrics/{lens}/seed{seed}/{measured_name}-frozen.csv",
    log:
        "results/{study}/logs/fine_tune/{lens}-{measured_name}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/fine_tune/{lens}-{measured_name}-seed{seed}.tsv"
    priority: early()
    resources:
        **needs("fine_tune", gpu=1),
    params:
        **call("tasklens.study.jobs.classify.fine_tune"),
        settings=settings(job_settings.FineTuningJob.of),
    script:
        "../scripts/job.py"


rule reproduce:
    """Classify the test images again with the stored weights and PSFs."""
    input:
        test=TEST,
        psf=psf,
        restoration=branch(lambda w: names.split(w.measured_name)[1], then=rules.restore.output.weights),
        weights=rules.fine_tune.output.weights,
    output:
        predictions="results/{study}/verification/{lens}/seed{seed}/{measured_name}-predictions.csv",
    log:
        "results/{study}/logs/reproduce/{lens}-{measured_name}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/reproduce/{lens}-{measured_name}-seed{seed}.tsv"
    resources:
        **needs("reproduce", gpu=1),
    params:
        **call("tasklens.study.jobs.classify.reproduce"),
        settings=settings(job_settings.ReproductionJob.of),
    script:
        "../scripts/job.py"
