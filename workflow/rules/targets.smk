"""Targets of the command line, for the study of the configuration; the first is the default."""


rule tables:
    """All tables of the study, their verdicts, and the page."""
    default_target: True
    input:
        [path_of(rules.table.output.csv, study, table=name) for study in POINTS for name in study.tables],
        at_points(rules.verdicts_table.output.csv),
        at_points(rules.psf_tail_table.output.csv),
        at_points(rules.effort_table.output.csv),
        at_points(rules.report_page.output.report),
        lambda _: [path_of(rules.report_page.output.report, part) for part in parts(STUDY)],
        path_of(rules.sweep_table.output.csv, STUDY) if STUDY.sweep else [],
    localrule: True


rule table1:
    """Task-driven lenses compared with lenses for image quality (table 1)."""
    input:
        at_points(rules.table.output.csv, table="table1"),
    localrule: True


rule table2:
    """The same lenses with other classifiers (table 2)."""
    input:
        at_points(rules.table.output.csv, table="table2"),
    localrule: True


rule table3:
    """Task-driven design compared with end-to-end design (table 3)."""
    input:
        at_points(rules.table.output.csv, table="table3"),
    localrule: True


rule table4:
    """The same lenses after image restoration (table 4)."""
    input:
        at_points(rules.table.output.csv, table="table4"),
    localrule: True


rule verdicts:
    """Each claim of the paper: difference, interval, and whether it holds."""
    input:
        at_points(rules.verdicts_table.output.csv),
    localrule: True


rule psf_tail:
    """Core, tail and encircled energy of the PSFs of the lenses in the tables."""
    input:
        at_points(rules.psf_tail_table.output.csv),
    localrule: True


rule effort:
    """Lenses tried and core-minutes of each design."""
    input:
        at_points(rules.effort_table.output.csv),
    localrule: True


rule report:
    """The report page."""
    input:
        at_points(rules.report_page.output.report),
    localrule: True


rule regimes:
    """Gain of task-driven design compared with the best imaging lens, by element count and specification."""
    input:
        at_points(rules.regimes_table.output.csv),
    localrule: True


rule ranking:
    """All lenses, ranked by the accuracy of the supervisor."""
    input:
        at_points(rules.ranking_table.output.csv),
    localrule: True


rule merit_function:
    """Loss of each classifier as a function of the MTF."""
    input:
        at_points(rules.merit_function_table.output.csv),
    localrule: True


rule tolerances:
    """Loss of accuracy of each design in manufacture."""
    input:
        at_points(rules.tolerances_table.output.csv),
    localrule: True


rule tasks:
    """Segmentation and detection of objects with each lens."""
    input:
        at_points(rules.tasks_table.output.csv),
    localrule: True


rule figures:
    """Drawings of every lens."""
    input:
        of_all_lenses(rules.drawing.output.figure),
    localrule: True


rule certificates:
    """A page for every lens."""
    input:
        of_all_lenses(rules.certificate.output.page),
    localrule: True


rule figure3:
    """Task-driven lenses and the best imaging lens of each element count (figure 3)."""
    input:
        compared_figures(rules.comparison.output.figure),
    localrule: True


rule figure4:
    """Whole frames through these lenses (figure 4)."""
    input:
        compared_figures(rules.frames.output.figure),
    localrule: True


rule ablations:
    """All ablations of the study."""
    input:
        [path for name in STUDY.ablations for path in at_points(rules.ablation.output.csv, ablation=name)],
    localrule: True


for name in STUDY.ablations:

    rule:
        name:
            f"ablation_{name}"
        input:
            at_points(rules.ablation.output.csv, ablation=name),
        localrule: True
