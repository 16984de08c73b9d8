# Sourced: the rig of the packages' tests, one simulated camera that starts at once.
rig_file() {
    cat <<RIG
rig = "clean"
[recording]
directory = "datasets"
color = "raw"
reserve_mb = 64
[[camera]]
name = "cam"
backend = "synthetic"
model = "generic"
cheap = true
[[camera.stream]]
name = "color"
width = 320
height = 240
rate_hz = 15.0
[[camera.stream]]
name = "depth"
width = 320
height = 240
rate_hz = 15.0
RIG
}
