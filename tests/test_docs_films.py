"""The films of the documentation show the policies that come with the package."""

import hashlib
import json
from pathlib import Path

import pytest

from cfp.policy import SHIPPED, shipped

FILMS = Path(__file__).resolve().parents[1] / "docs" / "images" / "films"


@pytest.mark.parametrize("name", shipped())
def test_film_is_of_the_present_policy(name):
    shown = json.loads((FILMS / "sources.json").read_text())[name]
    present = hashlib.sha256((SHIPPED / f"{name}.safetensors").read_bytes()).hexdigest()
    assert shown == present, f"python docs/media.py {name} makes the film anew"
    assert (FILMS / f"{name}.webp").exists()
