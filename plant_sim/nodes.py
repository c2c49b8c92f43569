"""Names and order of the 70 thermal nodes."""

SLICES = ("DE", "M", "NDE")
SIDES = ("DE", "NDE")
SLICE_NODES = ("CO", "HI", "YO", "YI", "T1", "T2", "WOp", "WOc", "WIp", "WIc", "AG", "RS", "MG", "RC")
SIDE_NODES = ("ERO", "ECO", "ERI", "ECI", "EA", "SF", "SH", "BI", "BO", "OH", "RP")

NODES: tuple[str, ...] = (
    *(f"{name}_{s}" for s in SLICES for name in SLICE_NODES),
    *(f"{name}_{s}" for s in SIDES for name in SIDE_NODES),
    *(f"SHF_{s}" for s in SLICES),
    *(f"HO_{s}" for s in SLICES),
)
INDEX: dict[str, int] = {name: i for i, name in enumerate(NODES)}
N_NODES = len(NODES)

# theta_w: end-winding crown, inner layer, non-drive end, where the NTC of a real machine sits.
THETA_W = INDEX["ECI_NDE"]
# theta_r: mean of the magnets, the demagnetisation-critical part.
THETA_R = tuple(INDEX[f"MG_{s}"] for s in SLICES)
# Hottest copper: slot core, inner layer, middle slice (2-4 K above theta_w).
HOT_SPOT = INDEX["WIc_M"]

# Columns of the boundary input.
COOLANT, AMBIENT, GEARBOX = 0, 1, 2
