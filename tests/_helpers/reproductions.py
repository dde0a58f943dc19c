"""Runs of reproductions on small data."""

from __future__ import annotations

from caper_jax import cli


def cells(text: str, *labels: str) -> list[str]:
    """The other cells of the one row of a markdown table that begins with these labels."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    (found,) = [row[len(labels) :] for row in rows if row[: len(labels)] == list(labels)]
    return found


def run(name, out, *options):
    return cli.main(["reproduce", name, *options, "--out", str(out)])
