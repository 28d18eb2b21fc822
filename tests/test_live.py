"""The page of a run that trains."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from simreal.live import CURVES, LivePage, page

ROWS = [
    {
        "step": 1000 * i,
        "wall_seconds": 2.0 * i,
        "episode_return": None if i < 3 else float(i),
        "success_rate": math.nan if i < 3 else i / 10,
        "quarantined": 1.0 if i == 5 else 0.0,
        **{name: 0.5 for name, _, _ in CURVES[2:]},
    }
    for i in range(1, 9)
]


def parsed(text: str) -> ET.Element:
    body = text[text.index("<main>") : text.index("</main>") + len("</main>")]
    return ET.fromstring(body)


def test_the_page_draws_what_is_known_and_reloads_until_the_end():
    text = page("arm <reach>", ROWS, 16000, done=False)
    assert 'http-equiv="refresh"' in text
    assert "arm &lt;reach&gt;" in text
    assert "8,000 of 16,000 steps" in text
    assert "16 s left" in text
    assert "1 worlds in quarantine" in text
    lines = parsed(text).findall(".//polyline")
    assert len(lines) == len(CURVES)
    assert len(lines[0].attrib["points"].split()) == 6, "two returns are not known"
    assert 'http-equiv="refresh"' not in page("arm", ROWS, 16000, done=True)


def test_the_page_is_drawn_without_any_episode():
    assert "nothing yet" in page("arm", ROWS[:1], 16000, done=False)


def test_the_page_is_not_written_at_every_row(tmp_path):
    live = LivePage(tmp_path / "report.html", "arm", 16000)
    live.show([])
    assert not live.file.exists()
    live.show(ROWS[:4])
    first = live.file.read_text()
    live.show(ROWS)
    assert live.file.read_text() == first
    live.show(ROWS, done=True)
    assert "ended: 8,000 of 16,000" in live.file.read_text()
