//! Families of objects: what a data set is split by.

use core::fmt;
use core::str::FromStr;

/// A family of objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Family {
    /// Cartons, books, bricks.
    Box,
    /// Balls.
    Ball,
    /// Superquadrics: from boxes with round edges to double cones.
    Superquadric,
    /// Cups and mugs, some with a handle.
    Cup,
    /// Bottles, jars and vases.
    Bottle,
    /// Bowls.
    Bowl,
    /// Plates.
    Plate,
    /// Forks, spoons and knives.
    Cutlery,
    /// Cables, some in loops.
    Cable,
    /// Cloths with folds.
    Cloth,
    /// Meshes that the user gives.
    Mesh,
}

impl Family {
    /// Every family.
    pub const ALL: [Self; 11] = [
        Self::Box,
        Self::Ball,
        Self::Superquadric,
        Self::Cup,
        Self::Bottle,
        Self::Bowl,
        Self::Plate,
        Self::Cutlery,
        Self::Cable,
        Self::Cloth,
        Self::Mesh,
    ];

    /// Its name in options and records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Box => "box",
            Self::Ball => "ball",
            Self::Superquadric => "superquadric",
            Self::Cup => "cup",
            Self::Bottle => "bottle",
            Self::Bowl => "bowl",
            Self::Plate => "plate",
            Self::Cutlery => "cutlery",
            Self::Cable => "cable",
            Self::Cloth => "cloth",
            Self::Mesh => "mesh",
        }
    }

    /// Weight of the choice among all.
    pub(crate) const fn weight(self) -> f32 {
        match self {
            Self::Box => 1.6,
            Self::Ball => 0.6,
            Self::Superquadric | Self::Bottle => 1.3,
            Self::Cup => 1.2,
            Self::Bowl | Self::Plate | Self::Cloth => 0.7,
            Self::Cutlery | Self::Cable => 0.8,
            Self::Mesh => 1.5,
        }
    }
}

impl fmt::Display for Family {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Family {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|f| f.name().eq_ignore_ascii_case(text)).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            format!("invalid family \"{text}\"; use {names}")
        })
    }
}
