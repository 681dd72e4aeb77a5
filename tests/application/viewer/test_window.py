"""The window on a saved result, in a real browser where there is one."""

import re

import numpy as np
import pytest

from browser import open_tab
from geogs.application.results.saved_result import load_result
from geogs.extras import install_command
from saved_results import IDS, make_result


@pytest.mark.system
def test_a_result_is_shown_in_the_browser(tmp_path):
    pytest.importorskip("viser", reason="viser is not installed")
    from geogs.application.viewer.saved import open_window

    result = load_result(make_result(tmp_path))
    window = open_window(result, "127.0.0.1", 8399)
    try:
        with open_tab(window.address, 480, 360) as tab:
            tab.page.wait_for_selector(f"text=keyframe 1 of {len(IDS)}", timeout=600_000)
            for name in ("Mesh", "Disks", "Path", "Keyframes", "Follow", "Layer"):
                assert tab.page.get_by_text(name, exact=True).count() >= 1
            tab.page.wait_for_timeout(3000)
            assert window.clients == 1
            assert tab.picture("canvas").std() > 2  # frusta and their images
            window._layer.value = "depth"
            tab.page.wait_for_timeout(500)
            depth = np.asarray(window._picture.image)
            assert depth.std() > 20
    finally:
        window.stop()


def test_without_viser_it_is_a_sentence(tmp_path, monkeypatch):
    import sys

    from geogs.application.viewer.saved import open_window
    from geogs.errors import InputError

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=re.escape(install_command("viewer"))):
        open_window(load_result(make_result(tmp_path)), "127.0.0.1", 8398)
