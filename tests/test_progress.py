"""The line that says where training stands."""

from __future__ import annotations

import io

from rich.console import Console

from simreal.progress import Progress


def row(
    step: int, wall_seconds: float, episode_return: float = 1.5, success: float = 0.25
) -> dict[str, float]:
    return {
        "step": step,
        "wall_seconds": wall_seconds,
        "episode_return": episode_return,
        "success_rate": success,
        "steps_per_second": 1.0,
    }


def shown(rows: list[dict[str, float]], terminal: bool, every: float = 1e9) -> str:
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=120, highlight=False)
    with Progress(400_000, every=every, console=console) as progress:
        for i, r in enumerate(rows):
            progress.show(r, last=i == len(rows) - 1)
    return out.getvalue()


def test_speed_and_time_left_do_not_count_the_compilation() -> None:
    lines = shown([row(100_000, 50.0), row(200_000, 60.0), row(300_000, 70.0)], terminal=False, every=0.0)
    first, _, last = lines.splitlines()
    assert first == "0.10 M of 0.40 M steps   return 1.5   success 25 %"
    assert last == "0.30 M of 0.40 M steps   return 1.5   success 25 %   10,000 steps/s   0:10 left"


def test_a_pipe_gets_a_line_now_and_then_and_the_last() -> None:
    rows = [row(step, step / 1000) for step in range(1000, 11_000, 1000)]
    lines = shown(rows, terminal=False).splitlines()
    assert [line.split()[0] for line in lines] == ["1,000", "10,000"]


def test_a_terminal_is_updated_in_place() -> None:
    out = shown([row(1000, 1.0), row(2000, 2.0)], terminal=True)
    assert "1,000" in out
    assert "2,000" in out
    assert "\x1b[2K" in out, "the line before is erased"
    assert out.count("\n") <= 1


def test_numbers_that_are_not_known_yet_are_dashes() -> None:
    line = shown([row(1000, 1.0, float("nan"), float("nan"))], terminal=False)
    assert "return -   success -" in line
