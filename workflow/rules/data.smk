rule images:
    output:
        [layout.images(split) for split in ("train", "minival", "test")],
    log:
        f"{layout.root}/logs/images.log",
    threads: 1
    params:
        study=layout.study,
        job=jobs.images(study).model_dump_json(),
        code=code("images"),
    shell:
        "tasklens images {params.study} 2> {log}"
