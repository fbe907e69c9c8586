"""Targets of SHAPE MATCH: ours, and the user's."""

import cv2
import numpy as np
import pytest

import dittogym
from dittogym.tasks.targets import load_target

#: Published areas and centroids (row, column) of the reference's pictures.
FACTS = {"star": (463, (33.0, 31.9)), "I": (444, (31.5, 30.4)), "M": (435, (32.0, 31.7)), "T": (427, (30.5, 31.6))}


@pytest.mark.parametrize("name", FACTS)
def test_areas_and_centroids(name: str) -> None:
    area, centroid = FACTS[name]
    mask = load_target(name)
    assert mask.shape == (64, 64) and mask.dtype == bool
    assert mask.sum() == pytest.approx(area, rel=0.02)
    assert np.argwhere(mask).mean(0) == pytest.approx(centroid, abs=1.0)


def test_files_and_arrays_agree(tmp_path) -> None:
    mask = load_target("T")
    grey = mask.astype(np.uint8) * 255
    cv2.imwrite(str(tmp_path / "t.png"), grey)
    cv2.imwrite(str(tmp_path / "large.png"), cv2.resize(grey, (256, 256), interpolation=cv2.INTER_NEAREST))
    cv2.imwrite(str(tmp_path / "alpha.png"), np.dstack([np.full((64, 64, 3), 255, np.uint8), grey]))
    pictures = [tmp_path / "t.png", tmp_path / "large.png", str(tmp_path / "alpha.png"), mask, grey]
    pictures += [mask.astype(float), np.dstack([grey] * 3), grey.astype(np.uint16) * 257]
    for picture in pictures:
        assert np.array_equal(load_target(picture), mask)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("heart", r"target must be 'star', 'I', 'M', 'T', an array or the path of an image; no such file: 'heart'"),
        (np.zeros((64, 64), bool), "pixels of the shape and of the ground, got 0 of 4096"),
        (np.zeros((0, 3)), "shape"),
        (np.full((8, 8), 2.0), r"\[0, 1\]"),
        (np.full((8, 8), np.nan), r"\[0, 1\]"),
        (np.zeros((8, 8), np.int64), "bool, uint8, uint16 or floating point, got int64"),
    ],
)
def test_bad_targets(target: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dittogym.make_spec("shapematch", target=target)


def test_unreadable_file(tmp_path) -> None:
    path = tmp_path / "not_an_image.png"
    path.write_text("hello")
    with pytest.raises(ValueError, match="cannot be read as an image"):
        load_target(path)


def test_a_target_off_the_middle_is_pointed_out() -> None:
    mask = np.zeros((64, 64), bool)
    mask[:10, :10] = True
    with pytest.warns(UserWarning, match="off the middle"):
        load_target(mask)
