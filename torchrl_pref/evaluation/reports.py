"""Files of an evaluation: its records, and the tables, curves and figures that show them."""

from __future__ import annotations

from pathlib import Path

from torchrl_pref.evaluation.figures import figure_1, heldout_figure, reliability_figure
from torchrl_pref.evaluation.metrics import ALWAYS, METRICS
from torchrl_pref.evaluation.records import Records, write_records
from torchrl_pref.evaluation.tables import tables
from torchrl_pref.evaluation.views import write_curves
from torchrl_pref.runs import TABLES
from torchrl_pref.storage.writing import write_text


def write_report(folder: Path, records: Records) -> None:
    """Write all there is to an existing folder; print the tables and say where."""
    heldout = records.entries[0].protocol == "heldout"
    text, picture = tables(records), "heldout.png" if heldout else "figure_1.png"
    write_text(folder / TABLES, text)
    write_curves(folder / "curves.csv", records)
    (heldout_figure if heldout else figure_1)(records, folder / picture)
    pictures = [picture]
    for metric in (name for name in METRICS if name in records.metrics and name not in ALWAYS):
        figure_1(records, folder / f"{metric}.png", metric)
        pictures.append(f"{metric}.png")
    if "calibration" in records.metrics:
        reliability_figure(records, folder / "reliability.png")
        pictures.append("reliability.png")
    written = [TABLES, "curves.csv", *pictures, *write_records(folder, records)]
    print(f"\n{text}\nwritten to {folder}: {', '.join(written)}")
