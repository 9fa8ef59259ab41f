"""Damaged and foreign files: whatever they hold, they are read or refused. ``fuzz.py`` says how, and tries more."""

import os

import pytest
from fuzz import LOADERS, fuzz

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "40"))  # of each loader


@pytest.mark.parametrize("name", LOADERS)
def test_any_file_is_read_or_refused(name):
    tally = fuzz(name, EXAMPLES)
    said = [f"{kind}: {ascii(content)[:200]}\n{trace}" for kind, (content, trace) in tally.examples.items()]
    assert not said, "\n".join(said)
    assert tally.tried >= EXAMPLES // 2
    assert tally.refused > 0
