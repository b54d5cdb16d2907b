"""Examples, which `nanogs COMMAND --help` shows at its end."""

EXAMPLES = {
    "simplify": (
        "nanogs simplify scene.ply small.ply --ratio 10%",
        "nanogs simplify scene.ply small.sog --size 5MB",
        "nanogs simplify scene.ply page.html --count 100k",
    ),
    "lod": (
        "nanogs lod scene.ply levels/ --format sog",
        "nanogs lod scene.ply web/lod-meta.json --levels 1,0.5,0.25,0.1",
    ),
    "refit": ("nanogs refit scene.ply small.ply better.ply",),
    "convert": (
        "nanogs convert scene.ply scene.spz --sh-degree 1",
        "nanogs convert scans/ --out-dir web/ --format sog",
    ),
    "info": (
        "nanogs info scene.ply",
        "nanogs info scene.ply --views 8",
        "nanogs info scene.ply --photos photos/",
        "nanogs info scene.ply --packed .sog,.spz",
        "nanogs info scene.sog --json",
    ),
    "presets": ("nanogs presets",),
    "render": (
        "nanogs render scene.ply pictures/ --views 12",
        "nanogs render scene.ply pictures/ --pixels 1920x1080 --transparent",
    ),
    "compare": (
        "nanogs compare scene.ply small.ply --report report.html",
        "nanogs compare scene.ply tenth=a.ply hundredth=b.ply --json",
        "nanogs compare scene.ply small.ply --packed .sog",
    ),
    "view": ("nanogs view scene.ply", "nanogs view scene.ply small.ply -o page.html"),
    "studio": ("nanogs studio scene.ply", "nanogs studio scene.ply --preset fast --port 8000"),
    "bench": (
        "nanogs bench scene.ply --ratios 0.1,0.01 --out results/",
        "nanogs bench scene.ply --sizes-of-files 0.5MB,1MB,2MB --format sog --out results/",
    ),
    "warm": ("nanogs warm", "nanogs warm --workers 2 --json"),
    "demo": ("nanogs demo scene.ply", "nanogs demo scene.ply --count 100k"),
}
