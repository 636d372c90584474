"""Images, and classifiers trained on the sharp images."""


rule images:
    """Render or read the images, and split them into train, minival and test."""
    output:
        train="results/{study}/images/train.npy",
        train_labels="results/{study}/images/train.json",
        minival="results/{study}/images/minival.npy",
        minival_labels="results/{study}/images/minival.json",
        test="results/{study}/images/test.npy",
        test_labels="results/{study}/images/test.json",
    log:
        "results/{study}/logs/images.log",
    benchmark:
        "results/{study}/benchmarks/images.tsv"
    priority: early(1)  # it takes all cores, and nearly all other jobs wait for it
    threads: lambda w: 8 if study_of(w).images.folder else 1  # that decode photographs
    resources:
        **needs("images"),
    params:
        **call("tasklens.study.jobs.images.run"),
        settings=named(
            images=lambda study: study.images,
            source=lambda study: job_settings.source(study.images.folder),
        ),
    script:
        "../scripts/job.py"


TRAIN = [rules.images.output.train, rules.images.output.train_labels]
MINIVAL = [rules.images.output.minival, rules.images.output.minival_labels]
TEST = [rules.images.output.test, rules.images.output.test_labels]


rule reference:
    """Train a classifier on the sharp images, or take its published weights."""
    input:
        images=TRAIN,
        published=lambda w: study_of(w).classifier(w.classifier).weights or [],
    output:
        weights="results/{study}/classifiers/reference/{classifier}.safetensors",
    log:
        "results/{study}/logs/reference/{classifier}.log",
    benchmark:
        "results/{study}/benchmarks/reference/{classifier}.tsv"
    priority: early()
    resources:
        **needs("reference", gpu=1),
    params:
        **call("tasklens.study.jobs.train_classifier.run"),
        settings=settings(lambda study, classifier: study.classifier(classifier)),
    script:
        "../scripts/job.py"
