"""Put what ``bench gpu-proof`` left in its folder into the tables of a page."""

from __future__ import annotations

from twirl_mjx import files
from twirl_mjx.bench import gpu_proof, report
from twirl_mjx.bench.measure import Record
from twirl_mjx.bench.options import GpuTableBench


def measure(options: GpuTableBench) -> Record:
    """Return the results of a folder, and write their tables.

    Raises:
        ValueError: There are none, or the page has no marked section.
    """
    path = options.results / gpu_proof.MACHINE
    if not path.is_file():
        raise ValueError(
            f"{options.results} has no {gpu_proof.MACHINE}, so no proof was made there"
            " (nearest: twirl bench gpu-proof, then this)"
        )
    folder = gpu_proof.Folder(options.results)
    tables = {
        "gpu-parity": gpu_proof.PARITY,
        "gpu-timings": gpu_proof.TIMINGS,
        "gpu-training": gpu_proof.TRAINING,
    }
    parts = {name: {"rows": folder.read(table)} for name, table in tables.items()}
    record = {
        "part": "gpu-table",
        "machine": files.read_json(path, "the machine of a proof"),
        "parts": {name: part for name, part in parts.items() if part["rows"]},
    }
    sheets = report.sheets_of(record["parts"])
    report.write_section(options.page, report.markdown(sheets, record["machine"]))
    return record
