//! Samples of IMUs: listed, or written as a CSV or NPY file per unit.

use super::growing::GrowingFile;
use super::{FramesDone, SetChoice, make_folder_of, new_folder};
use crate::dataset::{Dataset, DatasetSet, PixelMode, SetReader};
use crate::fs::Fs;
use crate::npy;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{MOTION_FIELDS, MotionSample, StreamId};
use serde::Serialize;
use std::ops::{ControlFlow, Range};
use std::path::Path;

/// Format of a motion file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MotionForm {
    /// A line a sample under one line of names; empty where the sample has no such number.
    #[default]
    Csv,
    /// A NumPy array of records with the same names; NaN where the sample has no such number.
    Npy,
}

impl MotionForm {
    const fn extension(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Npy => "npy",
        }
    }
}

/// One sample: a line of the file, or a JSON object with the same names.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct MotionRow {
    /// Id of the set that it came with.
    pub set: u64,
    /// When the rotation was measured, UTC nanoseconds since 1970.
    pub utc_ns: i64,
    /// When the rotation was measured, nanoseconds on the host's monotonic clock.
    pub time_ns: i64,
    /// The same on the unit's clock, ticks.
    pub device_time: u64,
    /// Number of the sample.
    pub sequence: u64,
    /// The time is right within this much, nanoseconds.
    pub uncertainty_ns: u32,
    /// When the acceleration was measured, after `time_ns`, nanoseconds.
    pub accel_offset_ns: i32,
    /// Angular velocity about x, rad/s.
    pub gyro_x_rad_s: Option<f32>,
    /// About y.
    pub gyro_y_rad_s: Option<f32>,
    /// About z.
    pub gyro_z_rad_s: Option<f32>,
    /// Acceleration along x, m/s².
    pub accel_x_m_s2: Option<f32>,
    /// Along y.
    pub accel_y_m_s2: Option<f32>,
    /// Along z.
    pub accel_z_m_s2: Option<f32>,
    /// Temperature of the unit, °C.
    pub temperature_c: Option<f32>,
    /// [`MotionFlags`](depthrig_bus::MotionFlags) bits.
    pub flags: u32,
}

impl MotionRow {
    /// The names of the columns.
    pub const COLUMNS: [&'static str; 15] = [
        "set",
        "utc_ns",
        "time_ns",
        "device_time",
        "sequence",
        "uncertainty_ns",
        "accel_offset_ns",
        "gyro_x_rad_s",
        "gyro_y_rad_s",
        "gyro_z_rad_s",
        "accel_x_m_s2",
        "accel_y_m_s2",
        "accel_z_m_s2",
        "temperature_c",
        "flags",
    ];

    fn new(set: &DatasetSet, s: &MotionSample) -> Self {
        let known = |v: f32| v.is_finite().then_some(v);
        let [gx, gy, gz] = s.gyro_rad_s.map(known);
        let [ax, ay, az] = s.accel_m_s2.map(known);
        Self {
            set: set.id,
            utc_ns: s.time_ns.saturating_add(set.utc_offset_ns),
            time_ns: s.time_ns,
            device_time: s.device_time,
            sequence: s.sequence,
            uncertainty_ns: s.uncertainty_ns,
            accel_offset_ns: s.accel_offset_ns,
            gyro_x_rad_s: gx,
            gyro_y_rad_s: gy,
            gyro_z_rad_s: gz,
            accel_x_m_s2: ax,
            accel_y_m_s2: ay,
            accel_z_m_s2: az,
            temperature_c: known(s.temperature_c),
            flags: s.flags,
        }
    }

    /// The row as a line. A number of 32 bits is written with as many digits as give its bits back.
    pub fn csv(&self) -> String {
        let float = |v: Option<f32>| v.map_or_else(String::new, |v| v.to_string());
        let [gyro, accel] = [
            [self.gyro_x_rad_s, self.gyro_y_rad_s, self.gyro_z_rad_s],
            [self.accel_x_m_s2, self.accel_y_m_s2, self.accel_z_m_s2],
        ]
        .map(|three| three.map(float).join(","));
        format!(
            "{},{},{},{},{},{},{},{gyro},{accel},{},{}",
            self.set,
            self.utc_ns,
            self.time_ns,
            self.device_time,
            self.sequence,
            self.uncertainty_ns,
            self.accel_offset_ns,
            float(self.temperature_c),
            self.flags
        )
    }
}

/// The chosen sets of a unit.
struct Chosen {
    sets: SetReader,
    numbers: Range<usize>,
    unit: usize,
}

impl Chosen {
    fn new(dataset: &Dataset, unit: &StreamId, choice: SetChoice) -> Result<Self> {
        let units = &dataset.session().motion;
        let Some(index) = units.iter().position(|u| u.id == *unit) else {
            let names: Vec<_> = units.iter().map(|u| u.id.to_string()).collect();
            let has = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            let what = format!("there is no IMU {unit}; the dataset has {has}");
            return Err(Error::new(ErrorKind::BadInput, what));
        };
        let mut sets = dataset.set_reader()?;
        let numbers = choice.numbers(&mut sets)?;
        Ok(Self { sets, numbers, unit: index })
    }

    /// Calls `each` with every sample and its set; a break ends it.
    fn walk(
        &mut self,
        each: &mut dyn FnMut(&DatasetSet, &MotionSample) -> Result<ControlFlow<()>>,
    ) -> Result<FramesDone> {
        let mut done = FramesDone::default();
        self.sets.problems().to_vec().into_iter().for_each(|p| done.lose(p));
        for number in self.numbers.clone() {
            let set = match self.sets.read(number, PixelMode::None) {
                Ok(set) => set,
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => {
                    done.lose(e.to_string());
                    continue;
                }
            };
            done.sets += 1;
            for sample in set.motion.iter().filter(|m| m.unit == self.unit).flat_map(|m| &m.samples) {
                if each(&set, sample)?.is_break() {
                    done.ended = true;
                    return Ok(done);
                }
                done.frames += 1;
            }
        }
        Ok(done)
    }
}

/// Calls `each` with a row per sample of the IMU `unit` in the chosen sets; what is counted are samples.
///
/// # Errors
/// [`ErrorKind::BadInput`] for a unit that is not there, and as [`list_frames`](super::list_frames).
pub fn list_motion(
    dataset: &Dataset,
    unit: &StreamId,
    sets: SetChoice,
    each: &mut dyn FnMut(MotionRow) -> ControlFlow<()>,
) -> Result<FramesDone> {
    Chosen::new(dataset, unit, sets)?.walk(&mut |set, sample| Ok(each(MotionRow::new(set, sample))))
}

/// Writes `CAM/UNIT.csv` (or `.npy`) below the new folder `out` for each of `units`; what is counted are samples. A file that
/// is not finished is named `.part`.
///
/// # Errors
/// As [`list_motion`]; [`ErrorKind::AlreadyExists`] when `out` holds anything; and as writing does.
pub fn export_motion(
    fs: &dyn Fs,
    dataset: &Dataset,
    units: &[StreamId],
    sets: SetChoice,
    form: MotionForm,
    out: &Path,
    progress: &mut dyn FnMut(u64) -> ControlFlow<()>,
) -> Result<FramesDone> {
    crate::check_outside(out, dataset.path())?;
    let mut chosen: Vec<_> = units.iter().map(|u| Chosen::new(dataset, u, sets)).collect::<Result<_>>()?;
    new_folder(fs, out)?;
    let mut total = FramesDone::default();
    for (id, chosen) in units.iter().zip(&mut chosen) {
        let path = out.join(id.camera.as_str()).join(format!("{}.{}", id.stream, form.extension()));
        make_folder_of(fs, &path)?;
        let mut file = GrowingFile::create(fs, &path)?;
        match form {
            MotionForm::Csv => file.put(format!("{}\n", MotionRow::COLUMNS.join(",")).as_bytes())?,
            // The length stands at the head: they are counted first.
            MotionForm::Npy => {
                let n = chosen.walk(&mut |_, _| Ok(ControlFlow::Continue(())))?.frames;
                file.put(&npy::records(&columns(), n))?;
            }
        }
        let before = total.frames;
        let done = chosen.walk(&mut |set, sample| {
            match form {
                MotionForm::Csv => {
                    let mut line = MotionRow::new(set, sample).csv();
                    line.push('\n');
                    file.put(line.as_bytes())?;
                }
                MotionForm::Npy => {
                    file.put(&set.id.to_le_bytes())?;
                    file.put(&sample.time_ns.saturating_add(set.utc_offset_ns).to_le_bytes())?;
                    file.put(&sample.to_bytes())?;
                }
            }
            total.frames += 1;
            // Not for each sample: the call would cost more than the sample.
            Ok(if total.frames % 1024 == 0 { progress(total.frames) } else { ControlFlow::Continue(()) })
        })?;
        total.sets = total.sets.max(done.sets);
        total.frames = before + done.frames;
        total.bytes += file.bytes;
        // Of the same sets for each unit.
        total.lost = total.lost.max(done.lost);
        if total.problems.is_empty() {
            total.problems = done.problems;
        }
        if done.ended {
            total.ended = true;
            return Ok(total);
        }
        file.finish()?;
    }
    Ok(total)
}

/// The columns of the NPY file with NumPy's names of their kinds: set and UTC, then the fields of a sample.
fn columns() -> Vec<(&'static str, &'static str, usize)> {
    let of = |f: &depthrig_bus::Field| {
        let kind = match f.kind {
            "i64" => "<i8",
            "u64" => "<u8",
            "i32" => "<i4",
            "u32" => "<u4",
            _ => "<f4",
        };
        (f.name, kind, f.count)
    };
    [("set", "<u8", 1), ("utc_ns", "<i8", 1)].into_iter().chain(MOTION_FIELDS.iter().map(of)).collect()
}
