"""Targets of SHAPE MATCH: ours, and the user's."""

import cv2
import numpy as np
import pytest

import dittogym
from dittogym.tasks.targets import ROBOT_AREA, load_target

#: Published areas and centroids (row, column) of the reference's pictures.
FACTS = {"star": (463, (33.0, 31.9)), "I": (444, (31.5, 30.4)), "M": (435, (32.0, 31.7)), "T": (427, (30.5, 31.6))}


@pytest.mark.parametrize("name", FACTS)
def test_areas_and_centroids(name: str) -> None:
    area, centroid = FACTS[name]
    mask = load_target(name)
    assert mask.shape == (64, 64) and mask.dtype == bool
    assert mask.sum() == pytest.approx(area, rel=0.02)
    assert np.argwhere(mask).mean(0) == pytest.approx(centroid, abs=1.0)


def heart(pixels: int = 320, centre: tuple[float, float] = (0.5, 0.5), scale: float = 0.02) -> np.ndarray:
    """A heart as (H, W) bool; centre and scale in units of the picture."""
    t = np.linspace(0, 2 * np.pi, 200)
    x = 16 * np.sin(t) ** 3
    y = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    corners = (np.stack((x, -y), 1) * scale + centre) * pixels
    image = np.zeros((pixels, pixels), np.uint8)
    cv2.fillPoly(image, [corners.round().astype(np.int32)], 1)
    return image.astype(bool)


def test_drawings_are_fitted_to_the_robot(tmp_path) -> None:
    """Whatever its ground, size and place, a drawing becomes the same target of the robot's area."""
    mask = heart()
    fitted = load_target(mask)
    assert fitted.sum() == pytest.approx(ROBOT_AREA, rel=0.05)
    assert np.argwhere(fitted).mean(0) == pytest.approx([31.5, 31.5], abs=0.5)
    red = np.where(mask[..., None], (40, 40, 220), (250, 250, 250)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "heart.jpg"), red, [cv2.IMWRITE_JPEG_QUALITY, 40])
    drawings = [heart(2000), heart(64), heart(centre=(0.3, 0.25), scale=0.01), np.pad(mask, ((0, 90), (0, 300)))]
    drawings.append([(0, -17), (14, -3), (16, 3), (12, 11), (5, 12), (0, 5), (-5, 12), (-12, 11), (-16, 3), (-14, -3)])
    for drawing in (tmp_path / "heart.jpg", *drawings):
        union = load_target(drawing) | fitted
        assert (load_target(drawing) & fitted).sum() > 0.9 * union.sum()
    for saved in (fitted, np.kron(fitted, np.ones((4, 4), bool))):  # what is saved can be loaded, at any size
        assert np.array_equal(load_target(saved), fitted)
    hole = mask & (np.hypot(*(np.mgrid[:320, :320] - 150)) > 40)
    assert not load_target(hole)[29:34, 29:34].all() and load_target(hole).sum() == pytest.approx(ROBOT_AREA, rel=0.05)


@pytest.mark.filterwarnings("ignore:no robot")
def test_a_drawing_need_not_be_fitted() -> None:
    mask = np.zeros((64, 64), bool)
    mask[2:12, 2:12] = True
    assert np.array_equal(dittogym.make_spec("shapematch", target=mask, fit=False).target, mask)
    with pytest.warns(UserWarning, match="100 pixels.*-25.0 rows and -25.0 columns off the middle"):
        load_target(mask, fit=False)


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        (np.tile(np.arange(64) // 16 % 2 == 1, (64, 1)), "2 separate parts"),
        (cv2.circle(np.zeros((400, 400), np.uint8), (200, 200), 150, 255, 4), "pixels, and a robot that is whole"),
    ],
)
def test_what_no_robot_can_match_is_pointed_out(target: np.ndarray, reason: str) -> None:
    with pytest.warns(UserWarning, match=reason):
        load_target(target)
