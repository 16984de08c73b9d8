//! The DPT head: four levels of tokens to one plane of inverse depth.

use super::layers::{Conv, ConvTranspose, Params};
use crate::arch::{Architecture, HEAD, OUTPUT_CHANNELS, PATCH};
use crate::{NetShape, Result};
use candle_core::{Result as Candle, Tensor};

pub(super) struct Head {
    projects: Vec<Conv>,
    /// 4 and 2 times larger, and half as large; the third level stays as it is.
    times4: ConvTranspose,
    times2: ConvTranspose,
    half: Conv,
    narrow: Vec<Conv>,
    /// From the coarsest level to the finest.
    refine: Vec<Refine>,
    conv1: Conv,
    conv2: Conv,
    conv3: Conv,
}

impl Head {
    pub(super) fn read(arch: &Architecture, params: &Params<'_>) -> Result<Self> {
        let ([l0, l1, _, l3], f) = (arch.levels, arch.features);
        let name = |part: &str| format!("{HEAD}.{part}");
        let scratch = |part: &str| format!("{HEAD}.scratch.{part}");
        let levels = || arch.levels.into_iter().enumerate();
        let projects = levels().map(|(i, c)| {
            Conv::read(params, &name(&format!("projects.{i}")), (c, 2 * arch.width, 1), (1, 0))
        });
        let narrow = levels().map(|(i, c)| {
            Conv::without_bias(params, &scratch(&format!("layer{}_rn", i + 1)), (f, c, 3), (1, 1))
        });
        Ok(Self {
            projects: projects.collect::<Result<_>>()?,
            times4: ConvTranspose::read(params, &name("resize_layers.0"), l0, 4)?,
            times2: ConvTranspose::read(params, &name("resize_layers.1"), l1, 2)?,
            half: Conv::read(params, &name("resize_layers.3"), (l3, l3, 3), (2, 1))?,
            narrow: narrow.collect::<Result<_>>()?,
            refine: [4, 3, 2, 1].map(|i| Refine::read(params, f, i)).into_iter().collect::<Result<_>>()?,
            conv1: Conv::read(params, &scratch("output_conv1"), (f / 2, f, 3), (1, 1))?,
            conv2: Conv::read(params, &scratch("output_conv2.0"), (OUTPUT_CHANNELS, f / 2, 3), (1, 1))?,
            conv3: Conv::read(params, &scratch("output_conv2.2"), (1, OUTPUT_CHANNELS, 1), (1, 0))?,
        })
    }

    /// `[1, 1, height, width]` from four levels of `[patches, 2 * width]`.
    pub(super) fn forward(&self, levels: &[Tensor], shape: NetShape) -> Candle<Tensor> {
        let (rows, columns) = (shape.height / PATCH, shape.width / PATCH);
        let mut maps = Vec::with_capacity(levels.len());
        for (i, (tokens, (project, narrow))) in
            levels.iter().zip(self.projects.iter().zip(&self.narrow)).enumerate()
        {
            let map = tokens.t()?.contiguous()?.reshape((1, (), rows, columns))?;
            let map = project.forward(&map)?;
            let map = match i {
                0 => self.times4.forward(&map)?,
                1 => self.times2.forward(&map)?,
                2 => map,
                _ => self.half.forward(&map)?,
            };
            maps.push(narrow.forward(&map)?);
        }
        let mut path: Option<Tensor> = None;
        for (refine, i) in self.refine.iter().zip((0..maps.len()).rev()) {
            let (_, _, h, w) = maps[i].dims4()?;
            let to = if i == 0 { (2 * h, 2 * w) } else { (maps[i - 1].dim(2)?, maps[i - 1].dim(3)?) };
            path = Some(refine.forward(path.as_ref(), &maps[i], to)?);
        }
        let Some(path) = path else { candle_core::bail!("the head has no levels") };
        let full = self.conv1.forward(&path)?.upsample_bilinear2d(shape.height, shape.width, true)?;
        self.conv3.forward(&self.conv2.forward(&full)?.relu()?)?.relu()
    }
}

/// Joins a level with what came from the coarser ones, and makes it as large as the next.
struct Refine {
    /// Of the level itself; the coarsest has nothing to be joined with and skips it.
    unit1: Option<Residual>,
    unit2: Residual,
    out: Conv,
}

impl Refine {
    fn read(params: &Params<'_>, features: usize, number: usize) -> Result<Self> {
        let name = format!("{HEAD}.scratch.refinenet{number}");
        let unit = |i: usize| Residual::read(params, features, &format!("{name}.resConfUnit{i}"));
        Ok(Self {
            unit1: if number == 4 { None } else { Some(unit(1)?) },
            unit2: unit(2)?,
            out: Conv::read(params, &format!("{name}.out_conv"), (features, features, 1), (1, 0))?,
        })
    }

    fn forward(&self, coarser: Option<&Tensor>, level: &Tensor, to: (usize, usize)) -> Candle<Tensor> {
        let joined = match (coarser, &self.unit1) {
            (Some(coarser), Some(unit)) => (coarser + unit.forward(level)?)?,
            _ => level.clone(),
        };
        let refined = self.unit2.forward(&joined)?;
        self.out.forward(&refined.upsample_bilinear2d(to.0, to.1, true)?)
    }
}

/// `x + conv(relu(conv(relu(x))))`.
struct Residual {
    conv1: Conv,
    conv2: Conv,
}

impl Residual {
    fn read(params: &Params<'_>, features: usize, name: &str) -> Result<Self> {
        let conv = |i: usize| Conv::read(params, &format!("{name}.conv{i}"), (features, features, 3), (1, 1));
        Ok(Self { conv1: conv(1)?, conv2: conv(2)? })
    }

    fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        x + self.conv2.forward(&self.conv1.forward(&x.relu()?)?.relu()?)?
    }
}
