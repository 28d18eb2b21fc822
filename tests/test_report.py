"""transfer.json, requirements, terminal table and report of a made-up evaluation."""

from __future__ import annotations

import dataclasses
import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simreal.errors import UserError
from simreal.evaluation import report
from simreal.evaluation.requirements import check, parse_requirement
from simreal.evaluation.results import ENDINGS, Evaluation, FactorCurve, HeatMap, SetResult
from simreal.evaluation.transfer import compare, terminal_table, transfer, write_transfer

NASTY = '<script>alert("x")</script> $mass & co'


def made_up_set(name: str, rate: float, seed: int, worlds: int = 64) -> SetResult:
    draws = np.random.default_rng(seed)
    success = np.arange(worlds) < round(rate * worlds)
    returns = np.where(success, 100.0, 20.0) + draws.normal(size=worlds)
    return SetResult(
        name=name,
        description="made up",
        claims_outside=name not in ("nominal", "train"),
        digest=f"digest of {name}",
        draws={"motor_delay": draws.uniform(0.0, 0.1, worlds), NASTY: draws.normal(size=(worlds, 6))},
        episode_return=returns,
        success=success,
        steps=np.full(worlds, 500),
        ended_by=np.where(success, 0, 1),
        hardware={"peak_torque": draws.gamma(9.0, size=worlds), "power": np.full(worlds, np.nan)},
    )


def made_up_curve(factor: str, unit: str) -> FactorCurve:
    values = np.linspace(0.0, 0.1, 6)
    success = np.tile((values <= 0.06)[:, None], (1, 32))
    return FactorCurve(factor, unit, values, 100.0 * success, success, 0.0, 0.04)


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    held_out = made_up_set("held_out", 0.75, 2)
    returns = held_out.episode_return.copy()
    returns[-1] = np.nan  # a world that diverged
    ended_by = held_out.ended_by.copy()
    ended_by[-1] = ENDINGS.index("diverged")
    sets = {
        "nominal": made_up_set("nominal", 1.0, 0),
        "train": made_up_set("train", 0.9375, 1),
        "held_out": dataclasses.replace(held_out, episode_return=returns, ended_by=ended_by),
        "lone": made_up_set("lone", 1.0, 3, worlds=1),
    }
    curves = {"motor_delay": made_up_curve("motor_delay", "s"), NASTY: made_up_curve(NASTY, "")}
    heat = HeatMap(
        "motor_delay", NASTY, np.linspace(0, 0.1, 3), np.linspace(0, 0.1, 4), np.ones((3, 4, 5), bool)
    )
    return Evaluation("arm_reach", "mujoco", 7, "runs/x", sets, curves, heat)


@pytest.fixture(scope="module")
def content(evaluation: Evaluation) -> dict[str, Any]:
    return transfer(evaluation)


def test_transfer_has_exactly_the_published_keys(content: dict[str, Any]) -> None:
    assert list(content) == ["schema", "engine", "seed", "sets", "factors"]
    assert (content["schema"], content["engine"], content["seed"]) == (1, "mujoco", 7)
    for row in content["sets"].values():
        assert list(row) == ["worlds", "digest", "return", "success", "gap", "hardware", "ended_by"]
        assert list(row["return"]) == [
            "mean",
            "mean_ci95",
            "iqm",
            "iqm_ci95",
            "cvar10",
            "cvar10_ci95",
            "worst",
        ]
        assert list(row["success"]) == ["rate", "ci95"]
        assert list(row["gap"]) == ["value", "ci95"]
        assert list(row["ended_by"]) == list(ENDINGS)
        assert sum(row["ended_by"].values()) == pytest.approx(1.0)
    assert [list(point) for point in content["factors"]["motor_delay"]] == [
        ["value", "return", "success"]
    ] * 6


def test_transfer_measures(content: dict[str, Any]) -> None:
    held_out, train = content["sets"]["held_out"], content["sets"]["train"]
    assert held_out["success"]["rate"] == 0.75
    assert held_out["gap"]["value"] == pytest.approx(0.9375 - 0.75)
    assert held_out["gap"]["ci95"][0] > 0.0
    assert train["gap"] == {"value": 0.0, "ci95": [0.0, 0.0]}
    assert held_out["return"]["cvar10"] < held_out["return"]["iqm"]
    assert held_out["return"]["worst"] == pytest.approx(held_out["return"]["cvar10"], abs=4.0)
    assert held_out["hardware"]["power"] == {"mean": None, "max": None}
    assert content["sets"]["lone"]["return"]["mean_ci95"] is None


def test_gap_is_unknown_without_a_train_set(evaluation: Evaluation) -> None:
    alone = dataclasses.replace(evaluation, sets={"held_out": evaluation.sets["held_out"]})
    assert transfer(alone)["sets"]["held_out"]["gap"] == {"value": None, "ci95": None}


def test_transfer_file_is_json_without_nan(content: dict[str, Any], tmp_path: Path) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    text = write_transfer(content, tmp_path / "run" / "transfer.json").read_text()
    assert json.loads(text, parse_constant=refuse) == content
    with pytest.raises(ValueError, match="JSON"):
        write_transfer({"value": float("nan")}, tmp_path / "transfer.json")


def test_terminal_table_is_aligned(content: dict[str, Any]) -> None:
    lines = terminal_table(content).splitlines()
    column = lines[0].index("success")
    assert [line[column:].split()[0] for line in lines[2:6]] == ["100.0", "93.8", "75.0", "100.0"]
    assert "18.8 [" in lines[4]
    assert "nan" not in terminal_table(content)


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("held_out.success>=0.75", True),
        ("held_out.success > 0.75", False),
        ("held_out.success==0.75", True),
        ("held_out.success.low>=0.75", False),
        ("held_out.success.high>=0.75", True),
        ("train.return>80", True),
        ("train.return.low<80", False),
        ("train.iqm>=99", True),
        ("train.iqm.high>=99", True),
        ("train.cvar10<=99", True),
        ("train.worst<25", True),
        ("held_out.gap<=0.1", False),
        ("held_out.gap.high<=0.5", True),
    ],
)
def test_requirements(content: dict[str, Any], text: str, holds: bool) -> None:
    failures = check([parse_requirement(text, content["sets"])], content)
    assert (not failures) == holds
    if failures:
        assert failures[0].startswith(f"{text} does not hold: measured ")


def test_requirement_on_a_number_that_does_not_exist(content: dict[str, Any]) -> None:
    (failure,) = check([parse_requirement("lone.return.low>=0")], content)
    assert "cannot be judged" in failure


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("held_out.success", r"expected SET.METRIC, one of >= <= == > <, and a number"),
        ("held_out.success=>0.9", "expected SET.METRIC"),
        ("0.9<=held_out.success", "no metric '9'"),
        ("success>=0.9", "'success' names no metric, as 'success.success' would"),
        ("held_out.succes>=0.9", "no metric 'succes'; valid: success, "),
        ("held_out.worst.low>=0.9", "no metric 'worst.low'; valid: "),
        ("held_out.success.lo>=0.9", "no metric 'success.lo'; valid: success.low, "),
        ("held_out.success>=high", "'high' is not a number"),
        ("held_out.success>=nan", "'nan' is not a number"),
        ("held_out.success>=90", "write 0.9 for 90 %"),
        ("heldout.success>=0.9", "no set 'heldout'; valid: held_out, nominal, train"),
    ],
)
def test_bad_requirements_are_one_plain_line(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        parse_requirement(text, ["nominal", "train", "held_out"])
    assert "\n" not in str(error.value)
    assert text in str(error.value)


def test_unknown_set_is_found_when_checked(content: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="no set 'heldout'; valid: held_out, "):
        check([parse_requirement("heldout.success>=0.9")], content)


class Page(HTMLParser):
    """Every tag and everything that a browser would fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.fetched: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.fetched += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "poster")]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def page(
    evaluation: Evaluation, content: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Page]:
    folder = tmp_path_factory.mktemp("run")
    rows = [
        {
            "step": 1000,
            "episode_return": 1.0,
            "success_rate": None,
            "steps_per_second": 9.0,
            "wall_seconds": 1.0,
        },
        {
            "step": 2000,
            "episode_return": 5.0,
            "success_rate": 0.5,
            "steps_per_second": 9.0,
            "wall_seconds": 2.0,
        },
    ]
    video = folder / "video.gif"
    video.write_bytes(b"GIF89a")
    path = report.write_report(
        folder,
        evaluation,
        content,
        rows,
        {"seed": 0, "device": NASTY, "versions": {"jax": "1"}},
        f"# {NASTY}",
        "simreal evaluate runs/x --worlds 64",
        video=video,
        comparison=compare(evaluation, evaluation, ("wide", "narrow")),
    )
    return path, Page(path.read_text(encoding="utf-8"))


def test_report_is_self_contained(page: tuple[Path, Page]) -> None:
    path, parsed = page
    assert path.name == "report.html"
    assert parsed.fetched
    assert all(source.startswith("data:") for source in parsed.fetched)
    assert any(source.startswith("data:image/gif") for source in parsed.fetched)
    assert {"script", "link", "iframe", "object", "embed"}.isdisjoint(parsed.tags)
    assert "http:" not in parsed.text
    assert "https:" not in parsed.text
    names = {each.name for each in (path.parent / "plots").iterdir()}
    assert {"success.png", "factors.png", "factor_motor_delay.png", "heat_map.png", "training.png"} <= names


def test_report_escapes_names(page: tuple[Path, Page]) -> None:
    path, parsed = page
    assert NASTY in parsed.text
    assert "<script" not in path.read_text(encoding="utf-8")


def test_report_says_the_verdict_first(page: tuple[Path, Page]) -> None:
    text = " ".join(page[1].text.split())
    for words in (
        "In 64 held-out worlds, which it never trained on, it succeeds in 75.0 %",
        "18.8 points below the training worlds",
        "Moved alone, motor_delay costs most: 100.0 % success inside its training range, 0.0 % at",
        "No failure was seen on nominal and lone.",
        "diverged in some worlds of held_out",
        "The difference is not distinguishable from zero on nominal",
        "a benefit on held_out and lone",
        "simreal evaluate runs/x --worlds 64",
    ):
        assert words in text
    assert text.index("held-out worlds, which") < text.index("Every set of worlds")


def test_report_of_next_to_nothing(tmp_path: Path) -> None:
    sparse = Evaluation("arm_reach", "mujoco", 0, "", {"lone": made_up_set("lone", 0.0, 0, worlds=1)})
    path = report.write_report(tmp_path, sparse, transfer(sparse), [], {}, "", "simreal evaluate .")
    assert "The weakest set is lone, with 0.0 %" in path.read_text(encoding="utf-8")


def test_comparison_words() -> None:
    def row(low: float, high: float, outside: bool) -> dict[str, Any]:
        difference = {"value": (low + high) / 2, "ci95": [low, high]}
        return {"success_difference": difference, "claims_outside": outside}

    sets = {
        "nominal": row(-0.03, -0.01, False),
        "held_out": row(0.1, 0.3, True),
        "worn": row(-0.02, 0.04, True),
    }
    words = report.comparison_words({"labels": ["wide", "narrow"], "sets": sets})
    assert words == [
        "Wide succeeds more often than narrow on held_out (20.0 points, 10.0 to 30.0).",
        "Wide succeeds less often than narrow on nominal (-2.0 points, -3.0 to -1.0).",
        "The difference is not distinguishable from zero on worn (1.0 points, -2.0 to 4.0).",
        "Expected outside the training ranges, but not shown here: a benefit on worn.",
    ]
