//! Form of a network's inputs and outputs, as far as the file describes them.

use core::fmt;

/// An input or output of a network.
#[derive(Debug, Clone, PartialEq)]
pub struct Outlet {
    pub name: String,
    /// Its kind of numbers, for messages.
    pub kind: String,
    /// They are 32-bit floats.
    pub is_float: bool,
    /// `None` when it is not a tensor; -1 for a size that is only known at run time.
    pub shape: Option<Vec<i64>>,
}

impl fmt::Display for Outlet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(shape) = &self.shape else { return write!(f, "{} ({})", self.name, self.kind) };
        let sizes: Vec<_> =
            shape.iter().map(|n| if *n < 0 { "any".to_owned() } else { n.to_string() }).collect();
        write!(f, "{} ({} [{}])", self.name, self.kind, sizes.join(", "))
    }
}

/// How both images go in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Images {
    /// Each in an input.
    Two,
    /// In one input, the channels of the left one first.
    Stacked,
}

impl Images {
    pub const fn inputs(self) -> usize {
        match self {
            Self::Two => 2,
            Self::Stacked => 1,
        }
    }
}

/// Where the colour channels are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// `[1, channels, height, width]`.
    ChannelsFirst,
    /// `[1, height, width, channels]`.
    ChannelsLast,
}

/// Form of a network's inputs and outputs.
#[derive(Debug, Clone, PartialEq)]
pub struct Form {
    pub images: Images,
    pub layout: Layout,
    /// Channels of one image: 1 or 3.
    pub channels: usize,
    /// Size of its images, where it has one.
    pub width: Option<usize>,
    pub height: Option<usize>,
    /// Names of the inputs, left first.
    pub names: Vec<String>,
    /// The output that is the disparity.
    pub output: String,
    /// The output that is the confidence, 0 to 1, if there is one.
    pub confidence: Option<String>,
}

impl fmt::Display for Form {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let color = if self.channels == 3 { "rgb" } else { "grey" };
        write!(f, "inputs={} colors={color} output={}", self.names.join(","), self.output)?;
        self.confidence.as_ref().map_or(Ok(()), |c| write!(f, " confidence={c}"))
    }
}

const TAKEN: &str = "taken are two inputs [1, 3 or 1, height, width], left and right, or one input with both images \
    one behind the other as 6 or 2 channels, in 32-bit floats, with the channels second or last";

fn list(of: &[Outlet]) -> String {
    of.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

impl Form {
    /// Determines the form of a network from its inputs and outputs, or describes why it is unsupported.
    pub fn of(inputs: &[Outlet], outputs: &[Outlet]) -> Result<Self, String> {
        let refuse = |why: &str| format!("its inputs are {}: {why}; {TAKEN}", list(inputs));
        let (images, per_eye) = match inputs.len() {
            1 => (Images::Stacked, 2),
            2 => (Images::Two, 1),
            n => return Err(refuse(&format!("there are {n} of them"))),
        };
        let mut found: Option<(Layout, usize, Option<usize>, Option<usize>)> = None;
        for input in inputs {
            let Some(&[batch, b, c, d]) = input.shape.as_deref().filter(|_| input.is_float) else {
                return Err(refuse(&format!("{} is not an image in 32-bit floats", input.name)));
            };
            if batch > 1 {
                return Err(refuse(&format!("{} takes {batch} images at once", input.name)));
            }
            let colors = |n: i64| [1, 3].into_iter().find(|k| n == k * per_eye);
            let side = |n: i64| usize::try_from(n).ok();
            let this = match (colors(b), colors(d)) {
                (Some(k), _) => (Layout::ChannelsFirst, k as usize, side(d), side(c)),
                (None, Some(k)) => (Layout::ChannelsLast, k as usize, side(c), side(b)),
                (None, None) => {
                    return Err(refuse(&format!("{} has another number of channels", input.name)));
                }
            };
            if [this.2, this.3].contains(&Some(0)) {
                return Err(refuse(&format!("{} has no size", input.name)));
            }
            if found.is_some_and(|other| other != this) {
                return Err(refuse("they are not alike"));
            }
            found = Some(this);
        }
        let Some((layout, channels, width, height)) = found else { return Err(refuse("there are none")) };
        let mut names: Vec<String> = inputs.iter().map(|i| i.name.clone()).collect();
        let is = |i: usize, word: &str| names.get(i).is_some_and(|n| n.to_lowercase().contains(word));
        if is(0, "right") && is(1, "left") {
            names.reverse();
        }
        let (output, confidence) = output(outputs)?;
        Ok(Self { images, layout, channels, width, height, names, output, confidence })
    }

    /// The shape of each input for images of this width and height.
    pub fn shape(&self, (width, height): (usize, usize)) -> Vec<usize> {
        let channels = self.channels * if self.images == Images::Stacked { 2 } else { 1 };
        match self.layout {
            Layout::ChannelsFirst => vec![1, channels, height, width],
            Layout::ChannelsLast => vec![1, height, width, channels],
        }
    }
}

/// The outputs that are disparity and confidence.
fn output(outputs: &[Outlet]) -> Result<(String, Option<String>), String> {
    let named = |o: &&Outlet, word: &str| o.name.to_lowercase().contains(word);
    let confidence = outputs.iter().find(|o| named(o, "conf"));
    let rest: Vec<&Outlet> = outputs.iter().filter(|o| !named(o, "conf")).collect();
    let disparity: Vec<&Outlet> = rest.iter().copied().filter(|o| named(o, "disp")).collect();
    let refuse = |why: &str| {
        format!(
            "its outputs are {}: {why}; taken is one output [1, 1, height, width] of disparities in 32-bit floats, or \
             the one of several whose name has \"disp\" in it, and beside it one of confidences whose name has \"conf\"",
            list(outputs)
        )
    };
    let one = match (rest.as_slice(), disparity.as_slice()) {
        ([one], _) | (_, [one]) => *one,
        ([], _) => return Err(refuse("none is a disparity")),
        (_, []) => return Err(refuse("none of them is named as disparity")),
        _ => return Err(refuse("several of them are named as disparity")),
    };
    if !one.is_float {
        return Err(refuse(&format!("{} is not in 32-bit floats", one.name)));
    }
    Ok((one.name.clone(), confidence.map(|o| o.name.clone())))
}

/// Where the numbers of an image lie in an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Plane {
    /// From one pixel to the next.
    pub step: usize,
}

/// The plane of an output of this shape with `len` numbers, for images of `width` and `height`. Of the two channels of
/// a network that outputs shifts in x and y it is the first.
pub fn plane(shape: &[i64], len: usize, width: usize, height: usize) -> Result<Plane, String> {
    let wanted = |n: i64, side: usize| usize::try_from(n).is_ok_and(|n| n == side);
    let sizes: Vec<i64> = shape.iter().copied().filter(|n| *n != 1).collect();
    // A side of one pixel would be left out above; no camera has one.
    let is = |h: i64, w: i64| wanted(h, height) && wanted(w, width);
    let (step, planes) = match *sizes.as_slice() {
        [h, w] if is(h, w) => (1, 1),
        [2, h, w] if is(h, w) => (1, 2),
        [h, w, 2] if is(h, w) => (2, 2),
        _ => {
            return Err(format!(
                "is {shape:?} where the images are {width}x{height}; a disparity for each pixel is needed"
            ));
        }
    };
    if len != planes * width * height {
        return Err(format!("has {len} numbers, which is not what its shape {shape:?} says"));
    }
    Ok(Plane { step })
}
