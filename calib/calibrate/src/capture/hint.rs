//! The next view in words.

use super::estimate::Group;
use super::plan::{Aim, Planned, Wanted, best};
use super::poses::Tilt;
use super::progress::{Lacks, lacks, names, well_joined};
use super::{Capture, Outline, PATIENCE};
use crate::mount::{FEW_VIEWS, NAMES};
use depthrig_calib::Camera;
use serde::{Deserialize, Serialize};

/// The view that would help most.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hint {
    /// Instruction in words.
    pub text: String,
    /// The camera before which to hold the board; absent when only cameras are named that are to see it.
    pub camera: Option<String>,
    /// Cameras that would see it.
    pub seen_by: Vec<String>,
    /// Where its outline would be in that camera's image, as shares of width and height.
    pub outline: Option<Outline>,
    /// Its distance from that camera, metres.
    pub distance_m: Option<f64>,
    /// Its tilt.
    pub tilt: Option<Tilt>,
    /// Share of the summed variance of projection that the view would take away.
    pub gain: Option<f64>,
}

/// Change of distance that is worth a word.
const OTHER_DISTANCE: f64 = 0.15;

pub(super) fn hint(capture: &Capture) -> Option<Hint> {
    if capture.cameras.is_empty() {
        return None;
    }
    if capture.views.is_empty() {
        let all: Vec<usize> = (0..capture.cameras.len()).collect();
        let who = if all.len() > 1 { "as many cameras as possible see it" } else { "the camera sees it" };
        return Some(in_words(format!("hold the board still where {who}"), capture, &all));
    }
    let of: Vec<Lacks> = (0..capture.cameras.len()).map(|c| lacks(capture, c)).collect();
    let groups = well_joined(capture);
    let alone = of.iter().all(|l| !l.views && !l.certainty && l.parts.is_empty());
    if capture.group_count() > 1 && (alone || capture.views.len() - capture.joined.since < PATIENCE) {
        return join(capture);
    }
    // The first aim that some camera has; later ones are met on the way.
    let first = |lacks: &Lacks| lacks.certainty || lacks.views;
    let planned = planned(capture, &of, |lacks, _| first(lacks).then_some(Aim::Certainty))
        .or_else(|| {
            planned(capture, &of, |lacks, camera| {
                let coverage = &capture.knowledge.coverage[camera];
                (!lacks.parts.is_empty()).then_some(Aim::Coverage(coverage))
            })
        })
        .or_else(|| {
            let apart = groups.len() > 1;
            planned(capture, &of, |lacks, _| (lacks.shared || apart).then_some(Aim::Shared))
        });
    if let Some(planned) = planned {
        return Some(described(capture, &planned));
    }
    let needy = of.iter().position(|l| !l.is_nothing());
    needy
        .map(|camera| plain(capture, camera, &of[camera]))
        .or_else(|| if groups.len() > 1 { join(capture) } else { None })
}

/// The best view before cameras that have an aim.
fn planned<'a>(
    capture: &'a Capture,
    of: &[Lacks],
    aim: impl Fn(&Lacks, usize) -> Option<Aim<'a>>,
) -> Option<Planned> {
    let mut found: Option<Planned> = None;
    for group in &capture.knowledge.groups {
        let wanted: Vec<Wanted<'_>> = group
            .cameras
            .iter()
            .enumerate()
            .filter_map(|(local, camera)| Some(Wanted { camera: local, aim: aim(&of[*camera], *camera)? }))
            .collect();
        let planned = best(group, &capture.cameras, &capture.points, &wanted);
        if let Some(planned) = planned.filter(|p| found.as_ref().is_none_or(|f| p.gain > f.gain)) {
            found = Some(planned);
        }
    }
    if found.is_some() {
        return found;
    }
    // Cameras that no view has shown the board yet.
    let mut unseen = (0..capture.cameras.len()).filter(|c| capture.views_of(*c) == 0);
    unseen.find_map(|camera| {
        let aim = aim(&of[camera], camera)?;
        let k = &capture.knowledge.intrinsics[camera];
        let group = Group::unseen(camera, &capture.cameras[camera], k, &capture.points)?;
        let wanted = [Wanted { camera: 0, aim }];
        best(&group, &capture.cameras, &capture.points, &wanted)
    })
}

fn described(capture: &Capture, planned: &Planned) -> Hint {
    let name = &capture.cameras[planned.camera].name;
    let candidate = &planned.candidate;
    let part = NAMES[candidate.row][candidate.column];
    let far = match capture.distance_m(planned.camera) {
        Some(now) if candidate.distance_m > now * (1.0 + OTHER_DISTANCE) => "further away, at ",
        Some(now) if candidate.distance_m < now * (1.0 - OTHER_DISTANCE) => "nearer, at ",
        _ => "at ",
    };
    let tilt = match candidate.tilt {
        Tilt::None => "straight at the camera",
        Tilt::TopAway => "its top tilted away",
        Tilt::BottomAway => "its bottom tilted away",
        Tilt::LeftAway => "its left side tilted away",
        Tilt::RightAway => "its right side tilted away",
    };
    let k = &capture.knowledge.intrinsics[planned.camera];
    let size = capture.cameras[planned.camera].size;
    let lens = Camera::new(k).ok();
    Hint {
        text: format!("to {part} of {name}'s image, {far}{:.2} m, {tilt}", candidate.distance_m),
        camera: Some(name.clone()),
        seen_by: planned.seen_by.iter().map(|c| capture.cameras[*c].name.clone()).collect(),
        outline: lens.and_then(|l| capture.points.outline(&l, size, &candidate.camera_from_board)),
        distance_m: Some(candidate.distance_m),
        tilt: Some(candidate.tilt),
        gain: Some(planned.gain),
    }
}

/// Needs of a camera, where no pose can be planned.
fn plain(capture: &Capture, camera: usize, lacks: &Lacks) -> Hint {
    let name = &capture.cameras[camera].name;
    let text = match lacks.parts.first() {
        Some(part) if !lacks.views => format!("to {part} of {name}'s image"),
        _ if lacks.views => {
            format!("show {name} the board at another place, tilted ({FEW_VIEWS} views are needed)")
        }
        _ if lacks.shared => format!("hold the board where {name} and another camera see it"),
        _ => format!("show {name} the board nearer, tilted, at the edges of the image"),
    };
    in_words(text, capture, &[camera])
}

/// Asks for a view that joins two groups of cameras.
fn join(capture: &Capture) -> Option<Hint> {
    let groups = super::groups_of(capture.cameras.len(), &capture.views);
    let unseen = (0..capture.cameras.len()).filter(|c| capture.views_of(*c) == 0).map(|c| vec![c]);
    let mut all: Vec<Vec<usize>> = groups.into_iter().chain(unseen).collect();
    if all.len() < 2 {
        all = well_joined(capture);
    }
    all.sort_by_key(|g| core::cmp::Reverse(g.len()));
    let large = all.first()?;
    let small = all.get(1)?;
    let of = |group: &[usize]| match group {
        [one] => capture.cameras[*one].name.clone(),
        several => format!("one of {}", names(capture, several)),
    };
    let text = format!("hold the board where {} and {} see it at once", of(small), of(large));
    let both: Vec<usize> = small.iter().chain(large).copied().collect();
    Some(in_words(text, capture, &both))
}

fn in_words(text: String, capture: &Capture, seen_by: &[usize]) -> Hint {
    Hint {
        text,
        camera: None,
        seen_by: seen_by.iter().map(|c| capture.cameras[*c].name.clone()).collect(),
        outline: None,
        distance_m: None,
        tilt: None,
        gain: None,
    }
}
