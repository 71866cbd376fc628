"""The report of a measurement: tables and pictures of a database."""

from __future__ import annotations

from pathlib import Path

from tvbrdf_fitting.published.database import read_database

from .summary import write_summary
from .truth import read_truth


def make_report(database_path: Path | str, out_dir: Path | str) -> dict[str, Path]:
    """Write tables and pictures of a database into a folder.

    Parameters
    ----------
    database_path
        The database's folder.
    out_dir
        Where the report goes; made if it is not there.

    Returns
    -------
    dict
        The files by what they are: ``summary``, ``summary_json``, ``curves``, ``parameters``; from
        the second sample on, pictures carry the sample's folder, ``sample02/curves``. There is no
        picture of what was not measured or not fitted.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    from .curves import plot_curves
    from .parameters import plot_parameters

    database = read_database(database_path)
    truth = read_truth(database.path)
    out_dir = Path(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    files = {"summary": out_dir / "summary.txt"}
    files["summary_json"] = write_summary(files["summary"], database)
    for index, sample in enumerate(database.samples):
        key = f"{sample.folder.name}/" if index else ""
        beginning = f"{sample.folder.name}_" if index else ""
        if sample.scans:
            path = out_dir / f"{beginning}curves.png"
            files[f"{key}curves"] = plot_curves(sample, path)
        if any(scan.fit is not None for scan in sample.scans):
            path = out_dir / f"{beginning}parameters.png"
            files[f"{key}parameters"] = plot_parameters(sample, path, truth=truth)
    return files
