"""Reads a database of `entire farm` with Cinema's own reader and checks every image.

    python3 scripts/read-cinema.py NAME.cdb"""

import os
import sys

from cinemasci.cdb import cdb

folder = sys.argv[1]
database = cdb(folder)
assert database.read_data_from_file(), f"{folder}: Cinema's reader refuses it"
names = database.get_parameter_names()
assert names[-1] == "FILE", names
for column in ["volume", "rx_deg", "ry_deg", "predicted_s", "measured_s"]:
    assert database.parameter_exists(column), column
database.set_extract_parameter_names(["FILE"])
rows = database.con.execute("SELECT ry_deg, task, FILE FROM CINEMA").fetchall()
assert rows, f"{folder}: no row"
for _, task, file in rows:
    path = os.path.join(folder, file)
    assert not os.path.isabs(file) and os.path.getsize(path) > 0, path
    assert database.get_extracts({"task": task}) == [path], task
print(f"{len(rows)} images of {folder} are found by their parameters")
