"""Writes train.json: a few training steps in PyTorch (float64), which the Rust trainer must repeat.

    python make_train_golden.py

Adam, clipping at norm 1 (some steps clip, some do not), a cosine learning rate, mean squared error; all inputs, weights,
losses, gradient norms and learning rates are in the file.
"""

import json
from pathlib import Path

import torch
from torch import nn

STEPS, ROWS, WIDTHS = 6, 70, (5, 8, 6, 1)
FIRST_RATE, LAST_RATE, CLIP = 2e-2, 1e-3, 1.0


def numbers(tensor):
    return [float(v) for v in tensor.flatten()]


def parameters(model, gradient=False):
    return [v for p in model.parameters() for v in numbers(p.grad if gradient else p.detach())]


def main():
    torch.manual_seed(7)
    torch.set_default_dtype(torch.float64)
    layers = []
    for i, (a, b) in enumerate(zip(WIDTHS, WIDTHS[1:])):
        layers.append(nn.Linear(a, b))
        if i + 2 < len(WIDTHS):
            layers.append(nn.SELU())
    model = nn.Sequential(*layers)
    optimizer = torch.optim.Adam(model.parameters(), lr=FIRST_RATE, betas=(0.9, 0.999), eps=1e-8)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS, eta_min=LAST_RATE)
    golden = {
        "made_with": f"PyTorch {torch.__version__}, float64, seed 7",
        "widths": WIDTHS,
        "steps": STEPS,
        "clip_norm": CLIP,
        "learning_rate": FIRST_RATE,
        "final_learning_rate": LAST_RATE,
        "initial": parameters(model),
        "batches": [],
    }
    for step in range(STEPS):
        inputs = torch.randn(ROWS, WIDTHS[0])
        # Small and large targets in turn, so that only some steps are clipped.
        targets = torch.sin(inputs.sum(1)) * (0.2 if step % 2 == 0 else 4.0)
        rate = optimizer.param_groups[0]["lr"]
        optimizer.zero_grad()
        loss = nn.functional.mse_loss(model(inputs)[:, 0], targets)
        loss.backward()
        gradient = parameters(model, gradient=True)
        norm = nn.utils.clip_grad_norm_(model.parameters(), CLIP)
        optimizer.step()
        schedule.step()
        golden["batches"].append(
            {
                "inputs": numbers(inputs),
                "targets": numbers(targets),
                "learning_rate": rate,
                "loss": loss.item(),
                "gradient_norm": float(norm),
                "gradient": gradient,
                "parameters": parameters(model),
            }
        )
    clipped = [b["gradient_norm"] > CLIP for b in golden["batches"]]
    assert any(clipped) and not all(clipped), clipped
    path = Path(__file__).with_name("train.json")
    path.write_text(json.dumps(golden) + "\n")
    print(f"wrote {path}; clipped: {clipped}")


if __name__ == "__main__":
    main()
