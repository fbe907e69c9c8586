"""The films of the documentation show the policies that come with the package."""

import hashlib
import json
from pathlib import Path

import pytest

import dittogym
from cfp.weights import SHIPPED

FILMS = Path(__file__).resolve().parents[1] / "docs" / "images" / "films"


@pytest.mark.parametrize("task", dittogym.TASKS)
def test_film_is_of_the_present_policy(task):
    shown = json.loads((FILMS / "sources.json").read_text())[task]
    shipped = hashlib.sha256((SHIPPED / f"{task}.safetensors").read_bytes()).hexdigest()
    assert shown == shipped, f"python docs/media.py {task} makes the film anew"
    assert (FILMS / f"{task}.webp").exists()
