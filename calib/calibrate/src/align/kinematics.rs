//! Forward kinematics of a tree of links.

use crate::Rigid;
use depthrig_calib::{Error, ErrorKind, Result};
use glam::{DQuat, DVec3};

/// How a joint moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointKind {
    /// Not at all.
    Fixed,
    /// Turns about its axis; positions are radians.
    Revolute,
    /// Slides along its axis; positions are metres.
    Prismatic,
}

/// The range of a joint's positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// The least, radians or metres.
    pub lower: f64,
    /// The greatest.
    pub upper: f64,
}

/// A joint that follows another one: `multiplier * position + offset`.
#[derive(Debug, Clone, PartialEq)]
pub struct Mimic {
    /// Name of the joint that it follows.
    pub joint: String,
    /// Factor.
    pub multiplier: f64,
    /// Radians or metres.
    pub offset: f64,
}

/// A joint between two links.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Its name.
    pub name: String,
    /// Index of the link that it is attached to.
    pub parent: usize,
    /// Index of the link that it moves.
    pub child: usize,
    /// Pose of the joint in the parent's frame.
    pub origin: Rigid,
    /// Axis in the joint's frame, of unit length.
    pub axis: DVec3,
    /// How it moves.
    pub kind: JointKind,
    /// Range of positions, if it has one.
    pub limits: Option<Limits>,
    /// The joint that it follows, if any.
    pub mimic: Option<Mimic>,
}

impl Joint {
    /// Whether a position has to be given.
    pub fn is_free(&self) -> bool {
        self.kind != JointKind::Fixed && self.mimic.is_none()
    }
}

/// A robot: its links, and each joint after the one that places its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Kinematics {
    links: Vec<String>,
    joints: Vec<Joint>,
    base: usize,
}

impl Kinematics {
    /// From the names of the links, and each joint, in any order. The base is the link that no joint moves.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when the links are no tree, a name is there twice, or a joint follows one that does not exist or does
    /// not move by itself.
    pub fn new(links: Vec<String>, mut joints: Vec<Joint>) -> Result<Self> {
        let count = joints.len();
        for (i, joint) in joints.iter().enumerate() {
            if joints[..i].iter().any(|j| j.name == joint.name) {
                return bad(format!("two joints are named {}; rename one", joint.name));
            }
            if joint.parent >= links.len() || joint.child >= links.len() {
                return bad(format!("joint {} has a link that does not exist", joint.name));
            }
            if joints[..i].iter().any(|j| j.child == joint.child) {
                return bad(format!("link {} is moved by two joints", links[joint.child]));
            }
            if let Some(mimic) = &joint.mimic
                && !joints.iter().any(|j| j.name == mimic.joint && j.is_free())
            {
                return bad(format!(
                    "joint {} follows {}, which is not a moving joint of the robot",
                    joint.name, mimic.joint
                ));
            }
        }
        let bases: Vec<usize> =
            (0..links.len()).filter(|link| joints.iter().all(|j| j.child != *link)).collect();
        let &[base] = bases.as_slice() else {
            let names: Vec<&str> = bases.iter().map(|b| links[*b].as_str()).collect();
            return bad(format!(
                "the robot has {} links that no joint moves ({}); it needs one, its base",
                names.len(),
                names.join(", ")
            ));
        };
        let mut placed = vec![false; links.len()];
        placed[base] = true;
        let mut ordered: Vec<Joint> = Vec::with_capacity(count);
        while let Some(next) = joints.iter().position(|j| placed[j.parent]) {
            let joint = joints.swap_remove(next);
            placed[joint.child] = true;
            ordered.push(joint);
        }
        if let Some(left) = joints.first() {
            return bad(format!("joint {} is part of a loop", left.name));
        }
        Ok(Self { links, joints: ordered, base })
    }

    /// Names of the links.
    pub fn links(&self) -> &[String] {
        &self.links
    }

    /// Index of the base.
    pub fn base(&self) -> usize {
        self.base
    }

    /// Each joint whose position [`Kinematics::poses`] wants, in its order.
    pub fn free_joints(&self) -> impl Iterator<Item = &Joint> {
        self.joints.iter().filter(|j| j.is_free())
    }

    /// Whether a joint moves any of the links for which `of` holds.
    pub fn moves(&self, joint: &str, of: impl Fn(usize) -> bool) -> bool {
        let mut moved = vec![false; self.links.len()];
        for j in &self.joints {
            let follows = j.mimic.as_ref().is_some_and(|m| m.joint == joint);
            moved[j.child] = moved[j.parent] || j.name == joint || follows;
        }
        (0..self.links.len()).any(|link| moved[link] && of(link))
    }

    /// Poses of the links in the base's frame, in the order of [`Kinematics::links`].
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for another number of positions than [`Kinematics::free_joints`] has.
    pub fn poses(&self, positions: &[f64]) -> Result<Vec<Rigid>> {
        let free: Vec<&str> = self.free_joints().map(|j| j.name.as_str()).collect();
        if free.len() != positions.len() {
            return bad(format!("{} positions for {} joints", positions.len(), free.len()));
        }
        let of = |name: &str| free.iter().position(|n| *n == name).map_or(0.0, |i| positions[i]);
        let mut poses = vec![Rigid::IDENTITY; self.links.len()];
        for joint in &self.joints {
            let position = match &joint.mimic {
                Some(mimic) => mimic.multiplier * of(&mimic.joint) + mimic.offset,
                None => of(&joint.name),
            };
            let motion = match joint.kind {
                JointKind::Fixed => Rigid::IDENTITY,
                JointKind::Revolute => {
                    Rigid { rotation: DQuat::from_axis_angle(joint.axis, position), translation: DVec3::ZERO }
                }
                JointKind::Prismatic => {
                    Rigid { rotation: DQuat::IDENTITY, translation: joint.axis * position }
                }
            };
            poses[joint.child] = poses[joint.parent].after(&joint.origin).after(&motion);
        }
        Ok(poses)
    }
}

fn bad<T>(what: String) -> Result<T> {
    Err(Error::new(ErrorKind::BadInput, what))
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::FRAC_PI_2;

    fn joint(name: &str, parent: usize, child: usize) -> Joint {
        Joint {
            name: name.to_owned(),
            parent,
            child,
            origin: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::X },
            axis: DVec3::Z,
            kind: JointKind::Revolute,
            limits: None,
            mimic: None,
        }
    }

    fn links(count: usize) -> Vec<String> {
        (0..count).map(|i| format!("l{i}")).collect()
    }

    #[test]
    fn links_follow_their_parents_in_whatever_order_they_come() {
        let mut last = joint("b", 1, 2);
        last.mimic = Some(Mimic { joint: "a".to_owned(), multiplier: -1.0, offset: 0.0 });
        let robot = Kinematics::new(links(3), vec![last, joint("a", 0, 1)]).unwrap();
        assert_eq!(robot.free_joints().map(|j| j.name.as_str()).collect::<Vec<_>>(), ["a"]);
        let poses = robot.poses(&[FRAC_PI_2]).unwrap();
        assert!((poses[1].translation - DVec3::X).length() < 1e-12);
        assert!((poses[2].translation - DVec3::new(1.0, 1.0, 0.0)).length() < 1e-12);
        // Turned there and back.
        assert!((poses[2].rotation * DVec3::X - DVec3::X).length() < 1e-12);
        assert!(robot.moves("a", |link| link == 2) && !robot.moves("a", |link| link == 0));
        assert!(robot.poses(&[]).is_err());
    }

    #[test]
    fn what_is_no_tree_is_refused() {
        let of = |joints: Vec<Joint>| Kinematics::new(links(3), joints).unwrap_err().to_string();
        assert!(of(vec![joint("a", 0, 1)]).contains("2 links that no joint moves (l0, l2)"));
        assert!(of(vec![joint("a", 1, 2), joint("b", 2, 1)]).contains("loop"));
        assert!(of(vec![joint("a", 0, 1), joint("b", 0, 1)]).contains("l1 is moved by two joints"));
        assert!(of(vec![joint("a", 0, 1), joint("a", 0, 2)]).contains("two joints are named a"));
    }
}
