"""Products of tiny files, put in place as real ones are."""

import json

from vinemap.product import store


def fill(folder, text="new", parcel="F", files=("F.gpkg", "F_dtm.tif")):
    for name in files:
        (folder / name).write_text(text)
    (folder / "run.json").write_text(
        json.dumps({"parcel": parcel, "files": {name: len(text) for name in files}, "text": text})
    )


def publish(target, text="new", **options):
    with store.product(target, **options) as draft:
        fill(draft, text)


def names(folder):
    return sorted(p.name for p in folder.iterdir())
