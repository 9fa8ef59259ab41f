"""Without viser the command says how to install it. (The other mistakes are in test_view.py: they need viser.)"""

from segvisrl_jax.cli import main
from segvisrl_jax.commands import view


def test_without_viser_there_is_one_line(capsys, monkeypatch):
    monkeypatch.setattr(view, "find_spec", lambda name: None)
    assert main(["view"]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert 'pip install "segvisrl_jax[view]"' in line
