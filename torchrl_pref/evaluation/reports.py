"""Files of an evaluation: its records, and the tables, curves and figure that are views of them."""

from __future__ import annotations

from pathlib import Path

from torchrl_pref.evaluation.figures import figure_1, heldout_figure
from torchrl_pref.evaluation.records import Records, write_records
from torchrl_pref.evaluation.tables import tables
from torchrl_pref.evaluation.views import write_curves
from torchrl_pref.storage.writing import write_text


def write_report(folder: Path, records: Records) -> None:
    """Write all there is to an existing folder; print the tables and say where."""
    heldout = records.entries[0].protocol == "heldout"
    text, picture = tables(records), "heldout.png" if heldout else "figure_1.png"
    write_text(folder / "tables.txt", text)
    write_curves(folder / "curves.csv", records)
    (heldout_figure if heldout else figure_1)(records, folder / picture)
    written = ["tables.txt", "curves.csv", picture, *write_records(folder, records)]
    print(f"\n{text}\nwritten to {folder}: {', '.join(written)}")
