"""Find a landing pad in a picture: train a small network on what `rotorgram capture` wrote.

    rotorgram capture examples/pad.toml --out runs/pad
    python examples/pad_detector.py runs/pad [--epochs 20] [--seed 0] [--out FILE.json]

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
    pictures, targets = [], []
    for image in coco["images"]:
        with Image.open(folder / image["file_name"]) as file:
            pictures.append(np.asarray(file).transpose(2, 0, 1))
        left, top, width, height = boxes.get(image["id"], [np.nan] * 4)
        middle = ((left + width / 2) / image["width"], (top + height / 2) / image["height"])
        targets.append((float(image["id"] in boxes), *middle))
    lines = (folder / "lerobot" / "meta" / "episodes.jsonl").read_text().splitlines()
    lengths = [json.loads(line)["length"] for line in lines]
    flights = np.repeat(np.arange(len(lengths)), lengths)
    stacked = torch.from_numpy(np.stack(pictures)).float() / 255
    return stacked, torch.tensor(targets, dtype=torch.float32), flights


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


def main() -> None:
    """Train, test, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    pictures, targets, flights = read(args.folder)
    held = torch.from_numpy(flights % 5 == 4)
    trained = torch.nonzero(~held).ravel()
    net, begun = network(), time.perf_counter()
    net(pictures[:1])
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)
    for _ in range(args.epochs):
        for rows in trained[torch.randperm(len(trained))].split(64):
            optimizer.zero_grad()
            loss_of(net(pictures[rows]), targets[rows]).backward()
            optimizer.step()
    seconds = time.perf_counter() - begun
    with torch.no_grad():
        out = torch.cat([net(part) for part in pictures[held].split(256)])
    told, size = targets[held], pictures.shape[-1]
    there = told[:, 0] > 0
    error = size * torch.linalg.vector_norm(out[there, 1:] - told[there, 1:], dim=1)
    mean = targets[trained][targets[trained, 0] > 0, 1:].mean(dim=0)
    blind = size * torch.linalg.vector_norm(mean - told[there, 1:], dim=1)
    result = {
        "pictures": {"trained": len(trained), "tested": len(told), "with a pad": int(there.sum())},
        "pixels": size,
        "epochs": args.epochs,
        "seconds": round(seconds, 1),
        "told right whether there is a pad": round(
            float(((out[:, 0] > 0) == there).float().mean()), 4
        ),
        "error of its middle, pixels": {
            "median": round(float(error.median()), 3),
            "90 %": round(float(error.quantile(0.9)), 3),
        },
        "the same of the mean place": {"median": round(float(blind.median()), 3)},
    }
    print(json.dumps(result, indent=2))
    if args.out:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
