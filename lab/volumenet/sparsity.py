"""Writes variants of volumes that differ in sparsity: in each, a share of the voxels, those of the least values, is 0.

    python sparsity.py --data PATH --out ../../out/variants --shares 0.5,0.8
    python sparsity.py --data PATH --out ../../out/variants --datasets nyx_cosmology --every 3

DATASET/MEMBER/t0010.nrrd becomes t0010.nrrd (the volume itself), t0010.s50.nrrd and t0010.s80.nrrd in the same folders
below --out. The threshold of a variant is the quantile of all voxels of its volume; voxels with the threshold's own value
are kept.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from itertools import groupby
from pathlib import Path

import nrrd
import numpy as np
from tqdm import tqdm

from volumenet import find_volumes

HERE = Path(__file__).resolve().parent


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=HERE.parent.parent / "data", help="folder with volumes")
    parser.add_argument("--datasets", type=lambda s: s.split(","), help="only these first-level folders")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th volume of each member (default 1)")
    parser.add_argument(
        "--shares",
        type=lambda s: [float(x) for x in s.split(",")],
        default=[0.5, 0.8],
        help="share of the voxels to set to 0, one variant for each (default 0.5,0.8)",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    args = parser.parse_args()
    if args.every < 1 or any(not 0.0 < s < 1.0 for s in args.shares):
        parser.error("--every must be at least 1 and each of --shares between 0 and 1")
    return args


def main() -> None:
    args = options()
    files = find_volumes(args.data, args.datasets)
    if not files:
        sys.exit(f"no .nrrd or .nhdr file under {args.data}; name a folder with --data")
    chosen = [f for _, of_member in groupby(files, key=lambda f: f.member) for f in list(of_member)[:: args.every]]
    for file in tqdm(chosen, unit="volume"):
        target = args.out / file.path.relative_to(args.data)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file.path, target)
        data, header = nrrd.read(str(file.path))
        for share in args.shares:
            sparse = np.where(data >= np.quantile(data, share, method="lower"), data, data.dtype.type(0))
            name = f"{target.stem}.s{round(100 * share)}{target.suffix}"
            nrrd.write(str(target.with_name(name)), sparse, header=header)
    print(f"{len(chosen)} volumes, {len(chosen) * len(args.shares)} variants in {args.out}")


if __name__ == "__main__":
    main()
