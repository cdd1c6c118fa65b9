"""Find a landing pad in a picture: train a small network on what `capture.py` wrote.

    rotorgram evaluate geometric --env rotorgram/Landing-v0 --vehicle crazyflie2 \\
        --episodes 100 --record runs/pad.mcap
    python examples/capture.py runs/pad.mcap --vehicle crazyflie2 --scene airport \\
        --cameras down down_segmentation --every 5 --aside 1 --tilt 0.4 --fast --out runs/pad
    python examples/pad_detector.py runs/pad [--epochs 20] [--seeds 1] [--out FILE.json]

It learns from four fifths of the flights whether the pad is in a picture, and where the middle of
its box is, and is tested on the others, which it never saw.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn

PAD = "task/disc of drone"


def read(folder: Path) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Pictures (n, 3, H, W), 0 to 1; targets (n, 3): there, column and row over the size; flights.

    The middle of the box of a pad that is not in the picture is nan.
    """
    coco = json.loads((folder / "coco.json").read_text())
    pad = next(one["id"] for one in coco["categories"] if one["name"] == PAD)
    boxes = {
        one["image_id"]: one["bbox"] for one in coco["annotations"] if one["category_id"] == pad
    }
    pictures = []
    targets = []
    flights = []
    for image in coco["images"]:
        with Image.open(folder / image["file_name"]) as file:
            pictures.append(np.asarray(file).transpose(2, 0, 1))
        left, top, width, height = boxes.get(image["id"], [np.nan] * 4)
        middle = ((left + width / 2) / image["width"], (top + height / 2) / image["height"])
        targets.append((float(image["id"] in boxes), *middle))
        flights.append(image["sequence"])
    stacked = torch.from_numpy(np.stack(pictures)).float() / 255
    return stacked, torch.tensor(targets, dtype=torch.float32), np.array(flights)


def network() -> nn.Sequential:
    """Three convolutions and two layers: a logit for there, column and row over the size."""
    layers: list[nn.Module] = []
    for inputs, outputs in ((3, 16), (16, 32), (32, 64)):
        layers += [nn.Conv2d(inputs, outputs, 5, stride=2, padding=2), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten(), nn.LazyLinear(64), nn.ReLU(), nn.Linear(64, 3))


def loss_of(out: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Of there or not, and of the place where there is a pad."""
    there = target[:, 0] > 0
    seen = nn.functional.binary_cross_entropy_with_logits(out[:, 0], target[:, 0])
    return seen + 10 * nn.functional.smooth_l1_loss(out[there, 1:], target[there, 1:], beta=0.05)


def trained_and_tested(
    pictures: torch.Tensor, targets: torch.Tensor, held: torch.Tensor, epochs: int, seed: int
) -> dict[str, float]:
    """Train on the pictures that are not held back, test on those that are."""
    torch.manual_seed(seed)
    rest = torch.nonzero(~held).ravel()
    net = network()
    begun = time.perf_counter()
    net(pictures[:1])
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)
    for _ in range(epochs):
        for rows in rest[torch.randperm(len(rest))].split(64):
            optimizer.zero_grad()
            loss_of(net(pictures[rows]), targets[rows]).backward()
            optimizer.step()
    seconds = time.perf_counter() - begun
    with torch.no_grad():
        out = torch.cat([net(part) for part in pictures[held].split(256)])
    told = targets[held]
    there = targets[held][:, 0] > 0
    error = pixels_off(out[there, 1:], told[there, 1:], pictures.shape[-1])
    return {
        "right about whether": round(float(((out[:, 0] > 0) == there).float().mean()), 4),
        "median error": round(float(error.median()), 3),
        "error of 90 %": round(float(error.quantile(0.9)), 3),
        "seconds": round(seconds, 1),
    }


def pixels_off(told: torch.Tensor, true: torch.Tensor, size: int) -> torch.Tensor:
    """Distances of places over the size, pixels."""
    return size * torch.linalg.vector_norm(told - true, dim=1)


def main() -> None:
    """Train, test, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    pictures, targets, flights = read(args.folder)
    held = torch.from_numpy(flights % 5 == 4)
    seen = targets[~held & (targets[:, 0] > 0), 1:]
    true = targets[held & (targets[:, 0] > 0), 1:]
    mean = pixels_off(seen.mean(dim=0), true, pictures.shape[-1])
    result = {
        "pictures": {"trained": int((~held).sum()), "tested": int(held.sum())},
        "tested with a pad": len(true),
        "pixels of a side": pictures.shape[-1],
        "epochs": args.epochs,
        "median error of the mean place": round(float(mean.median()), 3),
        "seeds": [
            trained_and_tested(pictures, targets, held, args.epochs, seed)
            for seed in range(args.seeds)
        ],
    }
    print(json.dumps(result, indent=2))
    if args.out:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
