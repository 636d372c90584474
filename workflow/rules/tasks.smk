"""Tasks other than classification: segmentation and detection of objects with each lens."""


rule scenes:
    """Render or read the images with objects, train and test."""
    output:
        train="results/{study}/images/scenes-train.npy",
        train_objects="results/{study}/images/scenes-train.safetensors",
        test="results/{study}/images/scenes-test.npy",
        test_objects="results/{study}/images/scenes-test.safetensors",
    log:
        "results/{study}/logs/scenes.log",
    benchmark:
        "results/{study}/benchmarks/scenes.tsv"
    resources:
        **needs("scenes"),
    params:
        **call("tasklens.study.jobs.render_scenes.run"),
        settings=named(
            scenes=lambda study: study.tasks.scenes,
            source=lambda study: job_settings.source(study.tasks.scenes.folder),
        ),
    script:
        "../scripts/job.py"


TRAINING_SCENES = [rules.scenes.output.train, rules.scenes.output.train_objects]
TEST_SCENES = [rules.scenes.output.test, rules.scenes.output.test_objects]


rule task_reference:
    """Train the network of a task on the sharp images with objects."""
    input:
        images=TRAINING_SCENES,
    output:
        weights="results/{study}/tasks/reference/{task}.safetensors",
    log:
        "results/{study}/logs/task_reference/{task}.log",
    benchmark:
        "results/{study}/benchmarks/task_reference/{task}.tsv"
    resources:
        **needs("task_reference", gpu=1),
    params:
        **call("tasklens.study.jobs.measure_tasks.train"),
        settings=named(name=lambda study, task: task, network=lambda study, task: study.task_network(task)),
    script:
        "../scripts/job.py"


rule task_fine_tune:
    """Fine-tune the network of a task on the captures of a lens, and score it at every field, also before fine-tuning."""
    input:
        training_scenes=TRAINING_SCENES,
        test_scenes=TEST_SCENES,
        reference=rules.task_reference.output.weights,
        psf=psf,
    output:
        weights="results/{study}/tasks/{lens}/seed{seed}/{task}.safetensors",
        metrics="results/{study}/metrics/{lens}/seed{seed}/task-{task}.csv",
    log:
        "results/{study}/logs/task_fine_tune/{lens}-{task}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/task_fine_tune/{lens}-{task}-seed{seed}.tsv"
    resources:
        **needs("task_fine_tune", gpu=1),
    params:
        **call("tasklens.study.jobs.measure_tasks.fine_tune"),
        settings=settings(task_jobs.TaskFineTuningJob.of),
    script:
        "../scripts/job.py"


rule tasks_table:
    """Make the table of tasks other than classification, with the scores for each lens, and draw PSFs of the lenses."""
    input:
        metrics=files_of(rules.task_fine_tune.output.metrics, task_jobs.tasks, "score_keys"),
        lenses=files_of(rules.design.output.lens, task_jobs.tasks, "drawn_keys"),
        psfs=files_of(rules.psfs.output.psf, task_jobs.tasks, "drawn_keys"),
    output:
        csv=report_output("results/{study}/tables/tasks.csv", "tasks", table="other tasks"),
        md="results/{study}/tables/tasks.md",
        figure=report_output("results/{study}/figures/tasks-psfs.png", "tasks", table="PSFs of other tasks"),
    log:
        "results/{study}/logs/tasks_table.log",
    benchmark:
        "results/{study}/benchmarks/tasks_table.tsv"
    resources:
        **needs("tasks_table"),
    params:
        **call("tasklens.study.report.task_table.make"),
        settings=settings(task_jobs.tasks),
    script:
        "../scripts/job.py"
