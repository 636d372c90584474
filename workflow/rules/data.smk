rule images:
    output:
        [layout.images(split) for split in ("train", "minival", "test")],
    log:
        f"{layout.root}/logs/images.log",
    threads: 8
    params:
        study=layout.study,
        job=jobs.images(study).model_dump_json(),
        source=lambda wildcards: study.images.folder and of_folder(study.images.folder),
        code=code("images"),
    shell:
        "tasklens images {params.study} --threads {threads} 2> {log}"
