"""Writes values.json: tables of vtkPiecewiseFunction and vtkColorTransferFunction for node lists that exercise midpoint,
sharpness, duplicate positions, ranges wider and narrower than the nodes, and clamping on and off.

    python -m pip install vtk && python make.py > values.json
"""

import json
import random

import vtk

SIZE = 256


def opacity_table(nodes, low, high, clamp):
    f = vtk.vtkPiecewiseFunction()
    f.AllowDuplicateScalarsOn()
    f.SetClamping(clamp)
    for x, y, midpoint, sharpness in nodes:
        f.AddPoint(x, y, midpoint, sharpness)
    table = [0.0] * SIZE
    f.GetTable(low, high, SIZE, table)
    return table


def color_table(nodes, low, high, clamp):
    f = vtk.vtkColorTransferFunction()
    f.AllowDuplicateScalarsOn()
    f.SetClamping(clamp)
    f.SetColorSpaceToRGB()
    for x, (r, g, b), midpoint, sharpness in nodes:
        f.AddRGBPoint(x, r, g, b, midpoint, sharpness)
    table = [0.0] * (3 * SIZE)
    f.GetTable(low, high, SIZE, table)
    return table


def random_nodes(rng, count, low, high, steps):
    xs = sorted(round(rng.uniform(low, high), 3) for _ in range(count))
    if steps:
        xs[1] = xs[0]
    picks = [0.0, 0.005, 0.01, 0.02, 0.3, 0.5, 0.98, 0.99, 0.995, 1.0]
    shape = lambda: (round(rng.choice([rng.random(), 0.0, 0.5, 1.0]), 3), rng.choice(picks + [round(rng.random(), 3)]))
    opacity = [(x, round(rng.random(), 3), *shape()) for x in xs]
    color = [(x, [round(rng.random(), 3) for _ in range(3)], *shape()) for x in xs]
    return opacity, color


def main():
    rng = random.Random(7)
    cases = []
    for i in range(12):
        low, high = [(0.0, 1.0), (0.0, 255.0), (-1024.0, 3071.0), (-0.5, 0.25)][i % 4]
        count = 1 if i == 5 else rng.randint(2, 7)
        opacity, color = random_nodes(rng, count, low, high, steps=i % 3 == 2 and count > 2)
        # Ranges equal to the range of the nodes, inside it, and beyond it.
        width = high - low
        a, b = [(low, high), (low + 0.2 * width, high - 0.3 * width), (low - 0.1 * width, high + 0.4 * width)][i % 3]
        clamp = i % 5 != 4
        cases.append({
            "range": [a, b],
            "clamp": clamp,
            "opacity_nodes": opacity,
            "color_nodes": color,
            "opacity": [float(f"{v:.8g}") for v in opacity_table(opacity, a, b, clamp)],
            "color": [float(f"{v:.8g}") for v in color_table(color, a, b, clamp)],
        })
    print(json.dumps({"vtk": vtk.vtkVersion.GetVTKVersion(), "cases": cases}, separators=(",", ":")))


main()
