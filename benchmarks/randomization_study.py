"""Is randomisation worth it? Randomised against nominal training, on worlds that neither has seen.

For each environment, way of training and seed: one `simreal train`, then one `simreal evaluate` on every set
with the same worlds for all. Each run is a folder under `runs/study`; what is finished is not done again, and
what was interrupted is resumed, so the command can be stopped at any time and given again.

    python benchmarks/randomization_study.py [environment ...]      # prints a table, in Markdown
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from simreal.checkpoints import Checkpoints
from simreal.config_files import load_config
from simreal.evaluation.statistics import paired_seed_interval, seed_interval
from simreal.registry import environment_class
from simreal.runs import Run

SEEDS = {"cartpole_swingup": 5, "arm_reach": 5, "go2_walk": 3}
WAYS = ("train", "nominal")
FOLDER = Path("runs/study")


def simreal(*arguments: str) -> None:
    """One command; raises where it fails."""
    subprocess.run([sys.executable, "-m", "simreal.cli", *arguments], check=True)


def measure(environment: str, way: str, seed: int) -> dict:
    """The transfer.json of one run, trained and evaluated if it is not there yet."""
    out = FOLDER / environment / f"{way}-{seed}"
    sets = [worldset.name for worldset in environment_class(environment).world_sets]
    if not _trained(out, load_config(environment).steps):
        resume = ["--resume"] if (out / "config.yaml").exists() else []
        simreal("train", environment, "--randomization", way, "--seed", str(seed), "--out", str(out), *resume)
    if not (out / "transfer.json").exists():
        simreal("evaluate", str(out), "--sets", ",".join(sets))
    return json.loads((out / "transfer.json").read_text())


def _trained(out: Path, steps: int) -> bool:
    """Whether a run folder holds a policy that has seen all its steps."""
    if not (out / "policy").is_dir():
        return False
    return max(Checkpoints(Run.open(out).checkpoints).steps(), default=0) >= steps


def table(environment: str, results: dict[str, list[dict]]) -> str:
    """Every seed's success per set, and the paired difference over seeds with its 95 % t interval."""
    seeds = range(SEEDS[environment])
    lines = [
        f"**{environment}** ({len(seeds)} seeds; success in %, every seed's, then the mean difference)",
        "",
        "| set | randomised | nominal | difference (95 %) |",
        "|---|---|---|---|",
    ]
    for name in results["train"][0]["sets"]:
        rates = {way: [100 * r["sets"][name]["success"]["rate"] for r in results[way]] for way in WAYS}
        gain = paired_seed_interval(rates["train"], rates["nominal"])
        cells = [" ".join(f"{rate:.1f}" for rate in rates[way]) for way in WAYS]
        mark = " *" if gain.excludes_zero else ""
        difference = f"{gain.value:+.1f} [{gain.low:+.1f}, {gain.high:+.1f}]{mark}"
        lines.append(f"| {name} | {cells[0]} | {cells[1]} | {difference} |")
    held_out = {way: [100 * r["sets"]["held_out"]["success"]["rate"] for r in results[way]] for way in WAYS}
    means = {way: seed_interval(held_out[way]) for way in WAYS}
    written = {way: f"{m.value:.1f} % [{m.low:.1f}, {m.high:.1f}]" for way, m in means.items()}
    gain = paired_seed_interval(held_out["train"], held_out["nominal"])
    verdict = "excludes zero" if gain.excludes_zero else "does NOT exclude zero"
    lines += [
        "",
        f"held_out: randomised {written['train']}, nominal {written['nominal']}; the interval of the "
        f"difference {verdict}. Worlds are the same for all; * marks intervals without zero.",
    ]
    return "\n".join(lines)


def main(environments: list[str]) -> None:
    tables = []
    for environment in environments:
        results: dict[str, list[dict]] = {way: [] for way in WAYS}
        for seed in range(SEEDS[environment]):
            for way in WAYS:
                results[way].append(measure(environment, way, seed))
        tables.append(table(environment, results))
    text = "\n\n".join(tables) + "\n"
    print(text)
    (FOLDER / "study.md").write_text(text)


if __name__ == "__main__":
    main(sys.argv[1:] or list(SEEDS))
