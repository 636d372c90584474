"""Targets of the command line, for the study of the configuration; `tables` is in the Snakefile."""


rule table1:
    """Task-driven lenses compared with lenses for image quality (table 1)."""
    input:
        at_points(rules.table.output.csv, table="table1"),


rule table2:
    """The same lenses with other classifiers (table 2)."""
    input:
        at_points(rules.table.output.csv, table="table2"),


rule table3:
    """Task-driven design compared with end-to-end design (table 3)."""
    input:
        at_points(rules.table.output.csv, table="table3"),


rule table4:
    """The same lenses after image restoration (table 4)."""
    input:
        at_points(rules.table.output.csv, table="table4"),


rule verdicts:
    """Each claim of the paper: difference, interval, and whether it holds."""
    input:
        at_points(rules.verdicts_table.output.csv),


rule psf_tail:
    """Core, tail and encircled energy of the PSFs of the lenses in the tables."""
    input:
        at_points(rules.psf_tail_table.output.csv),


rule effort:
    """Lens evaluations and time of each design."""
    input:
        at_points(rules.effort_table.output.csv),


rule report:
    """The report page."""
    input:
        at_points(rules.report_page.output.report),


rule regimes:
    """The verdicts, instead of this table of version 1.0."""
    input:
        at_points(rules.verdicts_table.output.csv),


rule ranking:
    """All lenses, ranked by the accuracy of the supervisor."""
    input:
        at_points(rules.ranking_table.output.csv),


rule merit_function:
    """Loss of each classifier as a function of the MTF."""
    input:
        at_points(rules.merit_function_table.output.csv),


rule tolerances:
    """Loss of accuracy of each design in manufacture."""
    input:
        at_points(rules.tolerances_table.output.csv),


rule tasks:
    """Segmentation and detection of objects with each lens."""
    input:
        at_points(rules.tasks_table.output.csv),


rule figures:
    """Drawings of every lens."""
    input:
        of_all_lenses(rules.drawing.output.figure),


rule certificates:
    """A page for every lens."""
    input:
        of_all_lenses(rules.certificate.output.page),


rule figure3:
    """Task-driven lenses and the best imaging lens of each element count (figure 3)."""
    input:
        compared_figures(rules.comparison.output.figure),


rule figure4:
    """Whole frames through these lenses (figure 4)."""
    input:
        compared_figures(rules.frames.output.figure),


rule ablations:
    """All ablations of the study."""
    input:
        [path for name in STUDY.ablations for path in at_points(rules.ablation.output.csv, ablation=name)],


for name in STUDY.ablations:

    rule:
        name:
            f"ablation_{name}"
        input:
            at_points(rules.ablation.output.csv, ablation=name),


rule unknown_ablation:
    """Reports an ablation that the study does not have."""
    input:
        no_ablation,
    output:
        "ablation_{unknown}",
