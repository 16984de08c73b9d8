//! The schema texts, in the `ros2msg` form: the definition, then each definition it uses after a `====` line.
//! The standard ones follow `common_interfaces` and `rcl_interfaces` (Apache-2.0), without their comments.

use crate::container::record::SchemaRecord;
use depthrig_bus::{DropReason, FIELDS, Field, MOTION_FIELDS};
use std::borrow::Cow;
use std::fmt::Write;

/// A message type of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Schema {
    Image,
    CompressedImage,
    CameraInfo,
    TfMessage,
    DiagnosticArray,
    Log,
    FrameInfo,
    FrameSet,
    ClockPair,
    Accounts,
    Checkpoint,
    CompressedDepth,
    MotionSamples,
    Imu,
    SignalSamples,
    JointState,
    PoseStamped,
    SignalValues,
}

impl Schema {
    pub(crate) const ALL: [Self; 18] = [
        Self::Image,
        Self::CompressedImage,
        Self::CameraInfo,
        Self::TfMessage,
        Self::DiagnosticArray,
        Self::Log,
        Self::FrameInfo,
        Self::FrameSet,
        Self::ClockPair,
        Self::Accounts,
        Self::Checkpoint,
        Self::CompressedDepth,
        Self::MotionSamples,
        Self::Imu,
        Self::SignalSamples,
        Self::JointState,
        Self::PoseStamped,
        Self::SignalValues,
    ];

    /// The types that carry an image.
    pub(crate) const IMAGES: [Self; 3] = [Self::Image, Self::CompressedImage, Self::CompressedDepth];

    /// The types that only a dataset with an IMU has.
    const MOTION: [Self; 2] = [Self::MotionSamples, Self::Imu];

    /// The types that only a segment with signals has.
    const SIGNALS: [Self; 4] = [Self::SignalSamples, Self::JointState, Self::PoseStamped, Self::SignalValues];

    /// The id of the schema record: 1, 2, … in the order of [`Self::ALL`].
    pub(crate) const fn id(self) -> u16 {
        self as u16 + 1
    }

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Image => "sensor_msgs/msg/Image",
            Self::CompressedImage => "sensor_msgs/msg/CompressedImage",
            Self::CameraInfo => "sensor_msgs/msg/CameraInfo",
            Self::TfMessage => "tf2_msgs/msg/TFMessage",
            Self::DiagnosticArray => "diagnostic_msgs/msg/DiagnosticArray",
            Self::Log => "rcl_interfaces/msg/Log",
            Self::FrameInfo => "depthrig_msgs/msg/FrameInfo",
            Self::FrameSet => "depthrig_msgs/msg/FrameSet",
            Self::ClockPair => "depthrig_msgs/msg/ClockPair",
            Self::Accounts => "depthrig_msgs/msg/Accounts",
            Self::Checkpoint => "depthrig_msgs/msg/Checkpoint",
            Self::CompressedDepth => "depthrig_msgs/msg/CompressedDepth",
            Self::MotionSamples => "depthrig_msgs/msg/MotionSamples",
            Self::Imu => "sensor_msgs/msg/Imu",
            Self::SignalSamples => "depthrig_msgs/msg/SignalSamples",
            Self::JointState => "sensor_msgs/msg/JointState",
            Self::PoseStamped => "geometry_msgs/msg/PoseStamped",
            Self::SignalValues => "depthrig_msgs/msg/SignalValues",
        }
    }

    /// The text of the definition with all that it uses.
    pub(crate) fn text(self) -> String {
        match self {
            Self::Image => with(IMAGE, &[HEADER_DEP, TIME_DEP]),
            Self::CompressedImage => with(COMPRESSED_IMAGE, &[HEADER_DEP, TIME_DEP]),
            Self::CameraInfo => with(CAMERA_INFO, &[HEADER_DEP, TIME_DEP, ROI_DEP]),
            Self::TfMessage => with(
                "geometry_msgs/TransformStamped[] transforms\n",
                &[TRANSFORM_STAMPED_DEP, HEADER_DEP, TIME_DEP, TRANSFORM_DEP, VECTOR3_DEP, QUATERNION_DEP],
            ),
            Self::DiagnosticArray => with(
                "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
                &[HEADER_DEP, TIME_DEP, STATUS_DEP, KEY_VALUE_DEP],
            ),
            Self::Log => with(LOG, &[TIME_DEP]),
            Self::FrameInfo => with(&frame_info(), &[TIME_DEP]),
            Self::FrameSet => with(FRAME_SET, &[TIME_DEP, MEMBER_DEP]),
            Self::ClockPair => with(CLOCK_PAIR, &[TIME_DEP]),
            Self::Accounts => with(&accounts(), &[TIME_DEP, STREAM_ACCOUNT_DEP]),
            Self::Checkpoint => with(CHECKPOINT, &[TIME_DEP]),
            Self::CompressedDepth => with(COMPRESSED_DEPTH, &[HEADER_DEP, TIME_DEP]),
            Self::MotionSamples => with(MOTION_SAMPLES, &[TIME_DEP, (MOTION_SAMPLE, &motion_sample())]),
            Self::Imu => with(IMU, &[HEADER_DEP, TIME_DEP, QUATERNION_DEP, VECTOR3_DEP]),
            Self::SignalSamples => with(SIGNAL_SAMPLES, &[TIME_DEP, SIGNAL_SAMPLE_DEP]),
            Self::JointState => with(JOINT_STATE, &[HEADER_DEP, TIME_DEP]),
            Self::PoseStamped => with(
                "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
                &[HEADER_DEP, TIME_DEP, POSE_DEP, POINT_DEP, QUATERNION_DEP],
            ),
            Self::SignalValues => with(SIGNAL_VALUES, &[HEADER_DEP, TIME_DEP, SIGNAL_VALUE_DEP]),
        }
    }

    /// The records of all types, as they stand at the head of a segment that has IMUs or not, signals or not.
    pub(crate) fn records(motion: bool, signals: bool) -> Vec<SchemaRecord> {
        let record = |s: Self| SchemaRecord {
            id: s.id(),
            name: s.name().to_owned(),
            encoding: "ros2msg".to_owned(),
            data: s.text().into_bytes(),
        };
        let is_there =
            |s: &Self| (motion || !Self::MOTION.contains(s)) && (signals || !Self::SIGNALS.contains(s));
        Self::ALL.into_iter().filter(is_there).map(record).collect()
    }
}

/// A definition that others use: its name and its text.
type Dep<'a> = (&'a str, &'a str);

fn with(text: &str, deps: &[Dep<'_>]) -> String {
    let rule = "=".repeat(80);
    let mut all = text.to_owned();
    for (name, text) in deps {
        let _ = write!(all, "{rule}\nMSG: {name}\n{text}");
    }
    all
}

const TIME_DEP: Dep<'_> = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n");
const HEADER_DEP: Dep<'_> = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n");
const ROI_DEP: Dep<'_> = (
    "sensor_msgs/RegionOfInterest",
    "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
);
const VECTOR3_DEP: Dep<'_> = ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n");
const QUATERNION_DEP: Dep<'_> =
    ("geometry_msgs/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n");
const TRANSFORM_DEP: Dep<'_> =
    ("geometry_msgs/Transform", "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n");
const TRANSFORM_STAMPED_DEP: Dep<'_> = (
    "geometry_msgs/TransformStamped",
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
);
const POINT_DEP: Dep<'_> = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n");
const POSE_DEP: Dep<'_> =
    ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n");
const KEY_VALUE_DEP: Dep<'_> = ("diagnostic_msgs/KeyValue", "string key\nstring value\n");
const STATUS_DEP: Dep<'_> = (
    "diagnostic_msgs/DiagnosticStatus",
    "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n\
     byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n",
);

const IMAGE: &str = "\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
";

const COMPRESSED_IMAGE: &str = "\
std_msgs/Header header
string format
uint8[] data
";

const CAMERA_INFO: &str = "\
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
";

const LOG: &str = "\
byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
";

const FRAME_SET: &str = "\
# The last message of a set: a set without it was not recorded whole and does not count.
# The tick on the host's CLOCK_MONOTONIC, as UTC.
builtin_interfaces/Time stamp
uint64 id
int64 tick_ns
# stamp - tick, nanoseconds: what was added to every monotonic time of this set.
int64 utc_offset_ns
# Latest minus earliest capture time among the members, nanoseconds.
int64 spread_ns
# Sets handed to the recorder so far, this one included: offered = recorded + sum(dropped).
uint64 sets_offered
depthrig_msgs/FrameMember[] members
# Streams (camera/stream) that have no frame in this set.
string[] missing
";

const CHECKPOINT: &str = "\
# What lies before: with it an unfinished file is proven without unpacking its chunks.
builtin_interfaces/Time stamp
# Bytes of the file before the chunk of this message, and their CRC-32 (ISO-HDLC, as everywhere in MCAP).
# Where file_bytes is not the offset of that chunk, the chunk was copied from another file: no use then.
uint64 file_bytes
uint32 crc32
";

const MEMBER_DEP: Dep<'_> = (
    "depthrig_msgs/FrameMember",
    "# camera/stream\nstring stream\nuint64 sequence\nint64 capture_time_ns\n\
     # Size and CRC-32 of the image message of this member.\nuint64 message_bytes\nuint32 message_crc32\n",
);

const CLOCK_PAIR: &str = "\
# One reading of both clocks of the host, about once a second.
builtin_interfaces/Time stamp
int64 monotonic_ns
int64 utc_ns
# The two were read within this, nanoseconds.
int64 width_ns
";

const COMPRESSED_DEPTH: &str = "\
# A depth image of 16 bit, without loss. docs/dataset-format.md of depthrig, \"Depth codec\", says how data is read;
# the Python package depthrig has decode_depth.
std_msgs/Header header
uint32 height
uint32 width
# Bytes from row to row once it is unpacked.
uint32 step
# Name and version of the codec: rank/1.
string codec
uint8[] data
";

const STREAM_ACCOUNT_DEP: Dep<'_> = (
    "depthrig_msgs/StreamAccount",
    "# captured = delivered + sum(dropped) since the stream began; dropped by reason as in FrameInfo.\n\
     string stream\nuint64 captured\nuint64 delivered\nuint64[8] dropped\n",
);

/// The definition of `FrameInfo`, made from the layout of the header so that the two cannot differ.
fn frame_info() -> String {
    let mut text = "# Every field of depthrig's frame header, bit by bit, in its order.\n".to_owned();
    let reasons: Vec<_> = DropReason::ALL.iter().map(|r| r.name()).collect();
    let _ = writeln!(text, "# dropped[i]: {}.", reasons.join(", "));
    fields(&mut text, FIELDS);
    text.push_str(
        "# Capture time as UTC, and the name of the optical frame.\nbuiltin_interfaces/Time stamp\n\
         string frame_id\n# How the pixels are stored: raw, jpeg, mjpeg, png or rank.\nstring codec\n",
    );
    text
}

const MOTION_SAMPLES: &str = "\
# A batch of samples of an IMU, oldest first. stamp is the time of the newest as UTC, sequence the number of the
# batch on its channel; frame_info has the rest. The array is the bytes of the batch.
builtin_interfaces/Time stamp
uint64 sequence
depthrig_msgs/MotionSample[] samples
";

const MOTION_SAMPLE: &str = "depthrig_msgs/MotionSample";

const IMU: &str = "\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
";

const SIGNAL_SAMPLES: &str = "\
# Samples of a signal, oldest first, all of one publisher: session is when it began, on the host's monotonic clock.
# stamp is the time of the newest as UTC. The channel's metadata description, JSON, names the fields of the values.
builtin_interfaces/Time stamp
uint64 session
depthrig_msgs/SignalSample[] samples
";

const SIGNAL_SAMPLE_DEP: Dep<'_> = (
    "depthrig_msgs/SignalSample",
    "# Number of the sample of its publisher: 1, 2, 3, ... A gap is samples that were not recorded.\n\
     uint64 sequence\n\
     # Nanoseconds of the host's monotonic clock: when the values were measured, and when they were published.\n\
     int64 time_ns\nint64 publish_time_ns\nuint64 uncertainty_ns\n\
     # 1 replayed, 2 time uncertain, 4 the time is that of publishing.\nuint32 flags\n\
     # As published: fields in their order, each element aligned to its size, a text last behind its length.\n\
     uint8[] values\n",
);

const JOINT_STATE: &str = "\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
";

const SIGNAL_VALUES: &str = "\
# A sample of a signal that is neither joints in SI units nor a pose.
std_msgs/Header header
depthrig_msgs/SignalValue[] fields
";

const SIGNAL_VALUE_DEP: Dep<'_> = (
    "depthrig_msgs/SignalValue",
    "string name\n# f64, f32, i64, bool or text.\nstring type\nstring unit\n\
     # One of the three has the elements: floats of f64 and f32, integers of i64 and bool, text.\n\
     float64[] floats\nint64[] integers\nstring text\n",
);

/// The definition of `MotionSample`, from the layout of the sample.
fn motion_sample() -> String {
    let mut text = "# Times in nanoseconds on the host clock, the unit's own time in ticks; rad/s and m/s2, NaN is none.\n\
                    # flags: 1 first after an exposure, 2 acceleration clipped, 4 rotation clipped.\n"
        .to_owned();
    fields(&mut text, MOTION_FIELDS);
    text
}

/// A line for each field of a layout.
fn fields(text: &mut String, fields: &[Field]) {
    for f in fields {
        let kind: Cow<str> = match f.kind {
            "f32" => "float32".into(),
            "f64" => "float64".into(),
            "i32" => "int32".into(),
            "i64" => "int64".into(),
            unsigned => unsigned.replace('u', "uint").into(),
        };
        let array = if f.count > 1 { format!("[{}]", f.count) } else { String::new() };
        let _ = writeln!(text, "{kind}{array} {}", f.name.replace('.', "_"));
    }
}

fn accounts() -> String {
    let reasons: Vec<_> = crate::SetDrop::ALL.iter().map(|r| r.name()).collect();
    format!(
        "# Cumulated numbers, about once a second and at the end of each segment.\n\
         builtin_interfaces/Time stamp\n\
         # sets_offered = sets_recorded + sum(sets_dropped); sets_dropped[i]: {}.\n\
         uint64 sets_offered\nuint64 sets_recorded\nuint64[{}] sets_dropped\n\
         depthrig_msgs/StreamAccount[] streams\n",
        reasons.join(", "),
        reasons.len()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_type_in_a_definition_is_defined_in_it() {
        for schema in Schema::ALL {
            let text = schema.text();
            for line in text.lines().filter(|l| l.contains('/') && !l.starts_with(['#', 'M'])) {
                let used = line.split([' ', '[']).next().unwrap();
                assert!(text.contains(&format!("MSG: {used}\n")), "{}: {used} is missing", schema.name());
            }
        }
    }

    #[test]
    fn ids_are_the_places_in_the_list() {
        for (i, s) in Schema::ALL.into_iter().enumerate() {
            assert_eq!(s.id() as usize, i + 1);
        }
    }
}
