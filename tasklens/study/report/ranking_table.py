"""The table and the page of a ranking of lenses that a study measured."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas
from scipy.stats import spearmanr

from tasklens.optics.io import prescription
from tasklens.optics.io.spec_section import view_of
from tasklens.recognition.metrics import mean_metrics
from tasklens.runtime.files import read_table, write_text
from tasklens.settings.names import SHARP
from tasklens.show import between_fields, lens_ranks, predictions
from tasklens.show.figures import section_svg
from tasklens.show.publish import publish
from tasklens.show.tolerance_page import distribution
from tasklens.study.report_jobs import RankingJob

_NOTE = """\
Study `{study}`, network {model}{tuned}, {images} photographs, each at {fields} fields. Intervals are 95 % over the
photographs. "Behind" is the accuracy of the first lens minus that of this one, on the same photographs. Lenses of a
group cannot be distinguished from the first of the group (paired, by the studentised range, 5 %)."""
_ZERO_SHOT = " The zero-shot accuracy is among all outputs of the network, the accuracy among those of the classes."


def make(
    settings: RankingJob,
    lenses: Sequence[Path],
    metrics: Sequence[Path],
    predicted: Sequence[Path],
    built: Sequence[Path],
    csv: Path,
    md: Path,
    page: Path,
) -> None:
    """Write the table as CSV and Markdown, and the page.

    Args:
        lenses: files of `settings.lens_keys`.
        metrics, predicted: measurements of `settings.measured_keys`.
        built: built lenses of `settings.built_keys`.
    """
    facts = settings.facts
    measured = dict(zip((SHARP, *settings.lenses), predicted, strict=True))
    correct = {lens: predictions.read(path) for lens, path in measured.items()}
    sharp = float(100 * correct.pop(SHARP).to_numpy().mean())
    in_nine = all(predictions.has(measured[lens], "nine") for lens in settings.lenses)
    at_nine = {lens: predictions.read(measured[lens], "nine") for lens in settings.lenses if in_nine}
    table = lens_ranks.rank_lenses(correct, at_nine)
    files = dict(zip(settings.lenses, lenses, strict=True))
    contents = {lens: prescription.read(path) for lens, path in files.items()}
    means = {lens: mean_metrics(path) for lens, path in zip((SHARP, *settings.lenses), metrics, strict=True)}
    losses = {lens: _loss_as_built(path) for lens, path in zip(facts.built, built, strict=True)}
    rows = []
    for lens in table["lens"]:
        content = contents[lens][1]
        row = {
            "f_number": content["figures"]["f_number"],
            "field_of_view_deg": content["spec"]["field_of_view_deg"],
            "rms_spot_um": content["means"]["rms_spot_um"],
        }
        if "zero_shot_accuracy" in means[lens]:
            row["zero_shot_accuracy"] = means[lens]["zero_shot_accuracy"]
        row |= {"mtf_mean": facts.mtf[lens]} if lens in facts.mtf else {}
        if "focus" in (origin := content["origin"]):  # of an imported lens
            row |= {"focus": origin["focus"], "image_plane_shift_um": 1e3 * origin["image_plane_shift_mm"]}
        rows.append(row | losses.get(lens, {}))
    table = table.join(pandas.DataFrame(rows))
    titles = {lens: facts.titles.get(lens, lens) for lens in settings.lenses}
    by_title = table.assign(lens=table["lens"].map(titles))
    tuned = f", after {settings.epochs:g} epochs of fine-tuning" if settings.epochs else ", as it is"
    count, fields = next(iter(correct.values())).shape
    note = _NOTE.format(study=settings.study, model=settings.model, tuned=tuned, images=count, fields=fields)
    answer = lens_ranks.sentences(by_title)
    answer += [text for text in [sieve(table, facts.mtf, settings.sieved)] if text is not None]
    between, at_nine_by_title = ({titles[lens]: part[lens] for lens in part} for part in (correct, at_nine))
    answer += between_fields.warnings(between, at_nine_by_title)
    left_out = [f"- {name}: {why}" for name, why in facts.left_out.items()]
    note += _ZERO_SHOT if "zero_shot_accuracy" in table else ""
    below = "\n\n".join([*answer, note, *(["Not measured:\n\n" + "\n".join(left_out)] if left_out else [])])
    publish(csv, md, by_title, below)
    drawings = {
        lens: section_svg(prescribed.lens, view_of(prescribed.lens, content, str(files[lens])))
        for lens, (prescribed, content) in contents.items()
    }
    words = {"title": f"Which lens for {settings.model}?", "images": count, "sharp": sharp, "tuned": tuned}
    words |= {"left_out": facts.left_out, "grade": settings.grade.replace("_", " ")}
    write_text(page, lens_ranks.render(table, titles, correct, drawings, answer, **words))


def sieve(table: pandas.DataFrame, mtf: Mapping[str, float], sieved: Sequence[str]) -> str | None:
    """Say which lenses the sieve by the MTF left out, and whether a better lens may be among them; None without one.

    A surprise is a lens of lower MTF that is more accurate than one of higher MTF.
    """
    if not sieved or len(table) < 3:
        return None
    mtfs, accuracies = table["lens"].map(mtf), table["accuracy"]
    rising = accuracies[mtfs.sort_values(kind="stable").index]  # with the MTF
    surprise = (rising.cummax() - rising).max()
    follows = "all have one accuracy"
    if accuracies.nunique() > 1:
        follows = f"accuracy follows the MTF with a rank correlation of {spearmanr(mtfs, accuracies).statistic:.2f}"
    needed = accuracies.iloc[0] - rising.iloc[0]
    least = max(mtf[name] for name in sieved)
    hope = "would be a surprise" if needed > surprise else "cannot be excluded"
    count = "1 lens" if len(sieved) == 1 else f"{len(sieved)} lenses"
    return (
        f"Not measured: {count} with a mean MTF of at most {least:.2f}. Among the measured lenses, {follows}; "
        f"a lens with a lower MTF was better by at most "
        f"{surprise:.1f} points. The measured lens with the lowest MTF is {needed:.1f} points behind the first, so a "
        f"better lens among those not measured {hope}."
    )


def _loss_as_built(path: Path) -> dict[str, float]:
    """Return the accuracy that built lenses lose against their design [points]: the mean, and the most of 95 %."""
    built = distribution(read_table(path).to_dict("records"))
    return {"built_lose": built["lost"], "built_lose_95": built["accuracy_design"] - built["accuracy_5th"]}
