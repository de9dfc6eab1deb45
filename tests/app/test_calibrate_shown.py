"""What `realsim calibrate` prints of further views: those that gain something, and nothing else."""

from types import SimpleNamespace

import pytest

import realsim_calibration
from realsim.app.calibrate.show import show_next_views
from realsim.app.console import Console
from realsim_calibration.planning import view_proposals


@pytest.mark.parametrize(("sigma_mm", "gains"), [(15.77, False), (15.7, False), (9.0, True)])
def test_views_that_gain_nothing_are_not_promised(monkeypatch, capsys, sigma_mm, gains):
    report = SimpleNamespace(
        here_mm=15.77, here_deg=0.4, sigma_mm=40.0, sigma_deg=0.9,
        used=(SimpleNamespace(joints=None),)
    )  # fmt: skip
    view = SimpleNamespace(
        distance_m=0.3, tilt_deg=25.0, roll_deg=15.0, sigma_mm=sigma_mm, sigma_deg=0.399
    )
    monkeypatch.setattr(view_proposals, "propose_views", lambda report: [view])
    monkeypatch.setattr(realsim_calibration, "choose_next_views", lambda *a: [view])
    show_next_views(report, Console())
    said = " ".join(capsys.readouterr().out.split())
    assert ("Further views that would help most" in said) == gains
    assert ("gain nothing: sigma stays at 15.77 mm" in said) == (not gains)
    assert gains or "joint angles with the poses" in said
    monkeypatch.setattr(realsim_calibration, "choose_next_views", lambda *a: [])
    show_next_views(report, Console())
    assert capsys.readouterr().out == ""
