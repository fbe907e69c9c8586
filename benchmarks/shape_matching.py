"""Open-loop gradient descent in SHAPE MATCH at full size: the table and the picture of docs/results.md.

Run `OMP_NUM_THREADS=1 python benchmarks/shape_matching.py --out runs/shapes`; results that the folder already holds are
kept. A target is a name, the path of an image, or a letter other than I, M and T, which is drawn here.
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np
import torch

import baselines
from baselines.train import main as train
from cfp.config import EVALUATION_SEED
from dittogym import TorchEnv
from dittogym.observation import silhouette
from dittogym.tasks.targets import load_target

LAYOUTS = 3
#: Pixels of a drawn letter; a robot at rest has 355.
AREA = 380
SCALE = 5


def letter(character: str) -> np.ndarray:
    """A letter as a (64, 64) uint8 picture, as large as `AREA` asks for, with its centroid in the middle."""
    for scale in np.arange(3.0, 9.0, 0.1):
        grey = np.zeros((256, 256), np.uint8)
        cv2.putText(grey, character, (60, 190), cv2.FONT_HERSHEY_SIMPLEX, scale, 255, 16, cv2.LINE_AA)
        moments = cv2.moments(grey)
        shift = [127.5 - moments[axis] / moments["m00"] for axis in ("m10", "m01")]
        centred = cv2.warpAffine(grey, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), (256, 256))
        small = cv2.resize(centred, (64, 64), interpolation=cv2.INTER_AREA)
        if (small >= 125).sum() >= AREA:
            return small
    raise SystemExit(f"targets: {character!r} cannot be drawn")


def play(policy: baselines.OpenLoop, target: str) -> dict[str, list]:
    """Return, intersection over union and final silhouette on layouts that were not trained on."""
    env = TorchEnv("shapematch", LAYOUTS, policy.resolution, target=target)
    observation, _ = env.reset(seed=2 * EVALUATION_SEED)
    memory, total = None, 0
    with torch.no_grad():
        for step in range(env.spec.horizon):
            action, memory = policy.predict(observation.numpy(), memory, np.full(LAYOUTS, step == 0))
            observation, reward, *_, info = env.step(torch.as_tensor(action))
            total = total + reward
    return {"returns": total.tolist(), "iou": info["iou"].tolist(), "silhouette": silhouette(observation)[0].tolist()}


def measure(target: str, out: Path, polish: int) -> dict:
    """Train for one target, unless that is done, and evaluate the result."""
    name, kept = Path(target).stem, out / f"{Path(target).stem}.json"
    if kept.exists():
        result = json.loads(kept.read_text())
        if result["polish"] != polish:
            raise SystemExit(f"{kept}: was measured with --polish {result['polish']}, got {polish}; use another --out")
        return result
    if len(target) == 1 and target not in "IMT":
        drawn = letter(target)
        target = str(out / f"{target}.png")
        cv2.imwrite(target, drawn)
    start = time.process_time()
    options = ["--algo", "gradient", "--task", "shapematch", "--target", target, "--polish", str(polish), "--no-video"]
    if train([*options, "--out", str(out / name), "--resume"]) != 0:
        raise SystemExit(f"{target}: training failed")
    minutes = (time.process_time() - start) / 60
    result = {"target": target, "polish": polish, "minutes": minutes, **play(baselines.load(out / name), target)}
    kept.write_text(json.dumps(result))
    return result


def row(result: dict) -> str:
    """A row of the table: means over the layouts."""
    returns, iou = np.array(result["returns"]), np.array(result["iou"])
    pixels = int(load_target(result["target"]).sum())
    name = Path(result["target"]).stem
    spread = f"{returns.mean():.0f} ± {returns.std():.0f}"
    return f"| {name} | {pixels} | {spread} | {iou.mean():.2f} | {result['minutes']:.1f} |"


def picture(results: list[dict]) -> np.ndarray:
    """Targets above final silhouettes on the first layout: covered pixels teal, missing orange, excess grey."""
    columns = []
    for result in results:
        target, found = load_target(result["target"]), np.array(result["silhouette"])
        top, bottom = (np.full((64, 64, 3), 255, np.uint8) for _ in range(2))
        top[target] = (40, 40, 40)
        bottom[target & found] = (128, 128, 0)
        bottom[target & ~found] = (40, 140, 240)
        bottom[~target & found] = (170, 170, 170)
        columns.append(np.pad(np.vstack((top, bottom)), ((2, 2), (2, 2), (0, 0)), constant_values=225))
    return np.kron(np.hstack(columns), np.ones((SCALE, SCALE, 1), np.uint8))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, default=Path("runs/shapes"), help="folder of the runs, table.md and picture.png"
    )
    parser.add_argument("--targets", nargs="+", default=["star", "I", "M", "T", "R"])
    parser.add_argument("--polish", type=int, default=0, help="iterations at full size")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = [measure(target, arguments.out, arguments.polish) for target in arguments.targets]
    head = f"| target | pixels | return, {LAYOUTS} layouts | IoU at the end | minutes of one core |"
    lines = [head, "| --- | --- | --- | --- | --- |", *map(row, found)]
    (arguments.out / "table.md").write_text("\n".join(lines) + "\n")
    cv2.imwrite(str(arguments.out / "picture.png"), picture(found))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
