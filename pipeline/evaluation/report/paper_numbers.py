"""The figures of the paper (Lu et al., CricaVPR, CVPR 2024), to stand beside ours.

Invariant: numbers are the paper's own, in percent, each with the table it comes from (its label in the paper's source)
and the protocol it was taken with: neighbouring images share an inference batch, 8 on Pittsburgh and 16 elsewhere
(supplement, inference batch size), 224 px, resized after normalising. A figure the paper does not give is None.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.evaluation.protocol import Protocol

Recalls = tuple[float | None, float | None, float | None]
"""Recall@1, 5 and 10 in percent."""


@dataclass(frozen=True)
class Reported:
    """A row of a table of the paper on one set."""

    recalls: Recalls
    """Recall@1, 5 and 10 in percent."""
    table: str
    """Label of the table in the paper's source."""
    group_size: int
    """Images that shared an inference batch, in file order."""

    def at(self, k: int) -> float | None:
        """Recall@k, None where the paper has none."""
        return dict(zip((1, 5, 10), self.recalls, strict=True)).get(k)


HEADLINE = "CricaVPR"
SETS = ("pitts30k", "tokyo247", "msls_val")

# rows on Pitts30k | Tokyo24/7 | MSLS-val, by the names of METHOD's variants; "-" is a figure not given
TABLES: dict[str, tuple[str, dict[str, str]]] = {
    "sota": (
        "tab:compare_SOTA",
        {
            "NetVLAD": "81.9 91.2 93.7 | 60.6 68.9 74.6 | 53.1 66.5 71.1",
            "SFRS": "89.4 94.7 95.9 | 81.0 88.3 92.4 | 69.2 80.3 83.1",
            "Patch-NetVLAD": "88.7 94.5 95.9 | 86.0 88.6 90.5 | 79.5 86.2 87.7",
            "TransVPR": "89.0 94.9 96.2 | 79.0 82.2 85.1 | 86.8 91.2 92.4",
            "CosPlace": "88.4 94.5 95.7 | 81.9 90.2 92.7 | 82.8 89.7 92.0",
            "GCL": "80.7 91.5 93.9 | 69.5 81.0 85.1 | 79.5 88.1 90.1",
            "MixVPR": "91.5 95.5 96.3 | 85.1 91.7 94.3 | 88.0 92.7 94.6",
            "EigenPlaces": "92.5 96.8 97.6 | 93.0 96.2 97.5 | 89.1 93.8 95.0",
            HEADLINE: "94.9 97.3 98.2 | 93.0 97.5 98.1 | 90.0 95.4 96.4",
        },
    ),
    "ablation_crica": (
        "tab:ablation_Crica",
        {
            "FrozenDINOv2-SPM": "74.8 90.1 - | 49.8 67.0 - | 45.4 60.7 -",
            "AdaptGeM": "87.1 94.0 - | 70.2 85.4 - | 78.4 87.8 -",
            "AdaptSPMG": "87.8 94.1 - | 72.1 85.1 - | 78.0 88.4 -",
            "AdaptSPM": "90.6 95.9 - | 85.1 93.3 - | 85.5 93.2 -",
            "AdaptGeM+Crica": "93.9 97.2 - | 87.6 93.3 - | 86.1 93.4 -",
            "AdaptSPMG+Crica": "94.3 97.3 - | 93.7 96.5 - | 89.7 95.3 -",
            "AdaptSPM+Crica": "94.8 97.4 - | 93.0 97.1 - | 89.9 95.4 -",
        },
    ),
    "ablation_adaptation": (
        "tab:ablation_adapt",
        {
            "FrozenDINOv2-GeM": "79.2 90.1 - | 65.4 83.8 - | 40.8 51.5 -",
            "MulConvAdapter-GeM": "87.1 94.0 - | 70.2 85.4 - | 78.4 87.8 -",
            "FrozenDINOv2": "79.2 90.1 - | 80.0 89.8 - | 58.8 71.2 -",
            "FullTunedDINOv2": "94.1 96.6 - | 76.8 88.3 - | 86.2 93.2 -",
            "VanillaAdapter": "94.6 97.4 - | 92.7 96.5 - | 89.2 95.5 -",
            "ConvAdapter": "93.8 96.9 - | 92.7 95.9 - | 88.0 94.2 -",
            "MulConvAdapter": "94.8 97.4 - | 93.0 97.1 - | 89.9 95.4 -",
        },
    ),
    "dimensions": (
        "tab:ablation_dim",
        {
            "512": "94.5 97.1 98.0 | 84.4 93.7 95.9 | 85.3 93.4 94.5",
            "1024": "94.8 97.3 98.1 | 91.4 96.8 97.8 | 87.7 94.3 95.3",
            "2048": "94.8 97.4 98.2 | 92.4 96.8 97.8 | 89.2 95.1 96.1",
            "4096": "94.9 97.3 98.2 | 93.0 97.5 98.1 | 90.0 95.4 96.4",
            "10752": "94.8 97.4 98.1 | 93.0 97.1 97.8 | 89.9 95.4 96.2",
        },
    ),
    "epochs": (
        "tab:epoch",
        {
            "10": "94.8 97.4 - | 93.0 97.1 - | 89.9 95.4 -",
            "5": "94.0 97.2 - | 93.3 96.2 - | 89.1 95.3 -",
            "1": "93.3 96.7 - | 92.7 95.9 - | 85.4 93.8 -",
            "0.1": "92.5 96.5 - | 88.9 96.2 - | 79.1 88.4 -",
        },
    ),
    "encoder_layers": (
        "suptab:encoder",
        {
            "0": "90.6 95.9 97.2 | 85.1 93.3 95.6 | 85.5 93.2 94.3",
            "1": "92.9 96.6 97.5 | 92.7 95.2 96.5 | 89.6 95.7 96.4",
            "2": "94.8 97.4 98.1 | 93.0 97.1 97.8 | 89.9 95.4 96.2",
            "3": "94.5 97.4 98.1 | 93.0 96.2 97.8 | 88.8 94.7 96.1",
        },
    ),
    "train_batch": (
        "suptab:batchsize",
        {
            "16": "89.5 95.3 96.8 | 75.6 89.2 91.4 | 80.9 90.4 92.7",
            "32": "89.9 95.2 96.7 | 81.3 91.1 93.0 | 83.0 93.1 93.8",
            "64": "90.7 95.9 97.5 | 84.4 94.3 96.5 | 84.1 92.3 94.2",
            "72": "90.6 95.9 97.2 | 85.1 93.3 95.6 | 85.5 93.2 94.3",
            "16+Crica": "94.6 97.0 97.7 | 87.9 94.9 96.2 | 84.1 92.6 94.2",
            "32+Crica": "94.8 97.4 98.0 | 91.1 94.9 96.8 | 85.0 93.1 95.1",
            "64+Crica": "94.9 97.5 98.1 | 92.4 95.6 97.1 | 88.1 95.0 95.1",
            "72+Crica": "94.8 97.4 98.1 | 93.0 97.1 97.8 | 89.9 95.4 96.2",
        },
    ),
    "inference_batch": (
        "suptab:infer_batchsize",
        {
            "1": "91.6 95.7 96.9 | 89.5 94.6 96.2 | 88.5 95.1 95.7",
            "4": "93.9 97.2 97.7 | 87.3 93.7 94.6 | 88.0 95.5 96.5",
            "8": "94.8 97.4 98.1 | 91.7 96.2 97.5 | 89.1 95.1 95.9",
            "16": "93.7 97.0 98.1 | 93.0 97.1 97.8 | 89.9 95.4 96.2",
            "32": "93.0 96.9 97.9 | 92.7 96.2 97.5 | 88.9 95.5 96.2",
        },
    ),
    "kernels": (
        "suptab:adapter",
        {
            "1x1": "94.5 97.2 97.8 | 91.7 95.9 97.1 | 88.2 95.3 95.5",
            "3x3": "94.3 97.1 97.9 | 91.7 95.2 96.8 | 87.6 94.3 95.8",
            "5x5": "94.7 97.3 97.8 | 90.2 94.6 96.8 | 87.6 95.1 96.4",
            "MulConv": "94.8 97.4 98.1 | 93.0 97.1 97.8 | 89.9 95.4 96.2",
        },
    ),
    "spm": (
        "suptab:ablation_spm",
        {
            "FrozenDINOv2-GeM": "79.2 90.1 - | 65.4 83.8 - | 40.8 51.5 -",
            "FrozenDINOv2-SPM": "74.8 90.1 - | 49.8 67.0 - | 45.4 60.7 -",
            "AdaptGeM": "87.1 94.0 - | 70.2 85.4 - | 78.4 87.8 -",
            "AdaptSPM": "90.6 95.9 - | 85.1 93.3 - | 85.5 93.2 -",
        },
    ),
}

# single rows on other sets: (table, set, row) -> recalls
OTHERS: dict[tuple[str, str, str], str] = {
    ("tab:compare_SOTA", "msls_challenge", "NetVLAD"): "35.1 47.4 51.7",
    ("tab:compare_SOTA", "msls_challenge", "SFRS"): "41.6 52.0 56.3",
    ("tab:compare_SOTA", "msls_challenge", "Patch-NetVLAD"): "48.1 57.6 60.5",
    ("tab:compare_SOTA", "msls_challenge", "TransVPR"): "63.9 74.0 77.5",
    ("tab:compare_SOTA", "msls_challenge", "CosPlace"): "61.4 72.0 76.6",
    ("tab:compare_SOTA", "msls_challenge", "GCL"): "57.9 70.7 75.7",
    ("tab:compare_SOTA", "msls_challenge", "MixVPR"): "64.0 75.9 80.6",
    ("tab:compare_SOTA", "msls_challenge", "EigenPlaces"): "67.4 77.1 81.7",
    ("tab:compare_SOTA", "msls_challenge", HEADLINE): "69.0 82.1 85.7",
    ("suptab:compare_SOTA", "nordland_2star", HEADLINE): "90.7 96.3 97.6",
    ("suptab:compare_SOTA", "amstertime", HEADLINE): "64.7 82.8 87.5",
    ("suptab:compare_SOTA", "svox_night", HEADLINE): "85.1 95.0 96.7",
    ("suptab:compare_SOTA", "svox_rain", HEADLINE): "95.0 98.2 98.7",
    ("suptab:compare_SOTA", "svox_sun", HEADLINE): "93.7 98.4 98.6",
    ("tab:gsv", "pitts250k", HEADLINE): "97.5 99.4 99.7",
    # section 14: trained on the same data; CricaVPR* is trained on Pitts30k
    ("tab:gsv", "pitts250k", "CosPlace-SF-XL"): "92.3 97.4 98.4",
    ("tab:gsv", "pitts250k", "NetVLAD-GSV-Cities"): "90.5 96.2 97.4",
    ("tab:gsv", "pitts250k", "CosPlace-GSV-Cities"): "91.5 96.9 97.9",
    ("tab:gsv", "msls_val", "CosPlace-SF-XL"): "87.4 94.1 94.9",
    ("tab:gsv", "msls_val", "NetVLAD-GSV-Cities"): "82.6 89.6 92.0",
    ("tab:gsv", "msls_val", "CosPlace-GSV-Cities"): "84.5 90.1 91.8",
    ("tab:pitts_crica", "pitts30k", "CricaVPR*"): "93.0 96.9 97.9",
    ("tab:pitts_crica", "pitts250k", "CricaVPR*"): "95.9 99.0 99.5",
    ("tab:pitts_crica", "pitts250k", "SFRS"): "90.7 96.4 97.6",
    ("tab:pitts_crica", "pitts250k", "MixVPR"): "94.1 98.2 98.9",
    ("tab:pitts_crica", "pitts250k", "EigenPlaces"): "94.1 97.9 98.7",
}
for _method, _row in {  # R@1, 5, 10 on Nordland **, AmsterTime, SVOX night, rain, sun
    "SFRS": "16.0 24.1 28.7 | 29.7 48.5 55.6 | 28.6 40.6 46.4 | 69.7 81.5 84.6 | 54.8 68.3 74.1",
    "CosPlace": "58.5 73.7 79.4 | 38.7 61.3 67.3 | 44.8 63.5 70.0 | 85.2 91.7 93.8 | 67.3 79.2 83.8",
    "MixVPR": "76.2 86.9 90.3 | 40.2 59.1 64.6 | 64.4 79.2 83.1 | 91.5 97.2 98.1 | 84.8 93.2 94.7",
    "EigenPlaces": "71.2 83.8 88.1 | 48.9 69.5 76.0 | 58.9 76.9 82.6 | 90.0 96.4 98.0 | 86.4 95.0 96.4",
}.items():
    for _set, _cells in zip(
        ("nordland_2star", "amstertime", "svox_night", "svox_rain", "svox_sun"), _row.split("|"), strict=True
    ):
        OTHERS["suptab:compare_SOTA", _set, _method] = _cells


def group_size(name: str) -> int:
    """The paper's inference batch on a set: 8 on Pittsburgh, 16 elsewhere."""
    return 8 if name in ("pitts30k", "pitts250k") else 16


def _recalls(cells: str) -> Recalls:
    one, five, ten = (None if cell == "-" else float(cell) for cell in cells.split())
    return one, five, ten


def table_row(table: str, row: str) -> dict[str, Reported]:
    """A row of `TABLES` as set -> figures; empty where the paper has no such row."""
    label, rows = TABLES.get(table, ("", {}))
    cells = rows[row].split("|") if row in rows else []
    found = {}
    for name, figures in zip(SETS, cells, strict=False):
        size = int(row) if table == "inference_batch" else group_size(name)
        found[name] = Reported(_recalls(figures), label, size)
    return found


def _protocol(name: str, table: str, row: str, size: int) -> str:
    kept = int({"sota": "4096", "dimensions": row}.get(table, "10752"))
    pca = None if kept == 10752 else kept
    return Protocol(groups="single" if size == 1 else "ordered", group_size=size, pca=pca).name


def _figures() -> dict[tuple[str, str, str], Reported]:
    figures = {}
    for (label, name, row), cells in OTHERS.items():
        ours = row.startswith("CricaVPR")
        protocol = _protocol(name, "sota", row, group_size(name)) if ours else ""
        figures[name, row, protocol] = Reported(_recalls(cells), label, group_size(name) if ours else 1)
    for row in TABLES["sota"][1]:
        ours = row == HEADLINE
        for name, reported in table_row("sota", row).items():
            protocol = _protocol(name, "sota", row, reported.group_size) if ours else ""
            figures[name, row, protocol] = reported if ours else Reported(reported.recalls, reported.table, 1)
    for table in ("dimensions", "inference_batch"):
        for row in TABLES[table][1]:
            for name, reported in table_row(table, row).items():
                figures.setdefault((name, HEADLINE, _protocol(name, table, row, reported.group_size)), reported)
    return figures


FIGURES: dict[tuple[str, str, str], Reported] = _figures()
"""(set, method, protocol) -> figures. Protocols are named as ours are, less the interpolation: `ordered8_pca4096`,
`single`; other people's methods, whose descriptors do not depend on a batch, have the protocol ''."""


def reported(name: str) -> Reported | None:
    """The paper's headline figures for a set (CricaVPR, 4096 dimensions), None where it has none."""
    return FIGURES.get((name, HEADLINE, _protocol(name, "sota", HEADLINE, group_size(name))))
