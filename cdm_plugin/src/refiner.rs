//! The refiner that is a network: images to its input, the network, its output to depth.

use crate::prep::{Positions, Prep, check_input_size, net_size};
use crate::workers::Workers;
use crate::{
    ChannelOrder, Description, Error, Job, Model, NetShape, Network, PositionEmbeddings, Refiner, Result,
    StepTimes,
};
use depthrig_bus::HostTime;
use std::sync::Arc;

/// Sizes of images, and of the network's input, that tables are kept for: more than a rig has.
const PREPS: usize = 16;
const POSITIONS: usize = 8;

/// A camera depth model: any [`Network`] with the official code's pre- and post-processing around it.
///
/// Jobs whose images become inputs of one size run together, [`Network::best_batch`] at a time. A job without any raw
/// depth that the network would see (all holes, full scale, or beyond [`Model::max_depth_m`]) comes out all holes, and the
/// network does not run for it: it would invent depth that nothing was measured for.
pub struct CdmRefiner {
    network: Box<dyn Network>,
    description: Description,
    channel_order: ChannelOrder,
    input_size: u32,
    max_depth_m: f64,
    positions: Positions,
    kept: Kept,
    workers: Arc<Workers>,
    prepared: Option<NetShape>,
    x: Vec<f32>,
    y: Vec<f32>,
    /// The jobs by the size of their input.
    order: Vec<((usize, usize), usize)>,
    /// Those of the batch that the network runs for.
    batch: Vec<usize>,
}

/// Cache of tables by image size; the oldest entry is evicted.
#[derive(Default)]
struct Kept {
    preps: Vec<(f64, Prep)>,
    positions: Vec<(NetShape, PositionEmbeddings)>,
}

impl Kept {
    /// The tables for the size and the unit of `job`.
    fn prep(
        &mut self,
        workers: &Arc<Workers>,
        job: &Job<'_>,
        input_size: u32,
        max_depth_m: f64,
    ) -> Result<&mut Prep> {
        let image = (job.color.width, job.color.height);
        let unit_m = job.depth.unit_m;
        let known = self.preps.iter().position(|(unit, prep)| *unit == unit_m && prep.image() == image);
        let i = if let Some(i) = known {
            i
        } else {
            let prep = Prep::with_workers(Arc::clone(workers), image.0, image.1, input_size, max_depth_m)?;
            if self.preps.len() == PREPS {
                self.preps.remove(0);
            }
            self.preps.push((unit_m, prep));
            self.preps.len() - 1
        };
        Ok(&mut self.preps[i].1)
    }

    fn positions(&mut self, learnt: &Positions, shape: NetShape) -> &PositionEmbeddings {
        let one = NetShape { batch: 1, ..shape };
        let i = self.positions.iter().position(|(known, _)| *known == one).unwrap_or_else(|| {
            if self.positions.len() == POSITIONS {
                self.positions.remove(0);
            }
            self.positions.push((one, learnt.at(one)));
            self.positions.len() - 1
        });
        &self.positions[i].1
    }
}

impl CdmRefiner {
    /// A refiner that runs `network`, which has the weights of `model`; `input_size` in place of the model's own. `threads`
    /// threads prepare and finish; 0 and 1 mean the caller's own.
    ///
    /// # Errors
    /// [`crate::ErrorKind::BadInput`] for an input size that cannot be used, [`crate::ErrorKind::BadModel`] when the
    /// model has no position embeddings, [`crate::ErrorKind::Engine`] when the system starts no more threads.
    pub fn new(
        network: Box<dyn Network>,
        model: &Model,
        input_size: Option<u32>,
        threads: usize,
    ) -> Result<Self> {
        let input_size = input_size.unwrap_or(model.input_size);
        check_input_size(input_size)?;
        let description = Description { engine: network.describe().into(), model: model.id.clone() };
        Ok(Self {
            network,
            description,
            channel_order: model.channel_order,
            input_size,
            max_depth_m: model.max_depth_m,
            positions: Positions::read(&model.encoder.architecture(), &model.weights)?,
            kept: Kept::default(),
            workers: Arc::new(Workers::new(threads)?),
            prepared: None,
            x: Vec::new(),
            y: Vec::new(),
            order: Vec::new(),
            batch: Vec::new(),
        })
    }

    /// Runs the jobs named in `order`, whose inputs are all of the size `net`.
    fn run(
        &mut self,
        jobs: &mut [Job<'_>],
        order: &[((usize, usize), usize)],
        net: (usize, usize),
    ) -> Result<()> {
        let shape = |batch| NetShape { batch, height: net.1, width: net.0 };
        let x_len = shape(1).input_len();
        let y_len = shape(1).output_len();
        self.x.resize(self.x.len().max(order.len() * x_len), 0.0);
        self.y.resize(self.y.len().max(order.len() * y_len), 0.0);
        self.batch.clear();
        for (_, i) in order {
            let job = &mut jobs[*i];
            let started = HostTime::now();
            let x = &mut self.x[self.batch.len() * x_len..][..x_len];
            let prep = self.kept.prep(&self.workers, job, self.input_size, self.max_depth_m)?;
            if prep.prepare(&job.color, &job.depth, self.channel_order, x)? {
                self.batch.push(*i);
            } else {
                job.out.clear();
            }
            job.steps.prepare_ns = since(started);
        }
        let started = HostTime::now();
        let shape = shape(self.batch.len());
        if shape.batch == 0 {
            return Ok(());
        }
        if self.prepared != Some(shape) {
            self.prepared = None;
            self.network.prepare(shape, self.kept.positions(&self.positions, shape))?;
            self.prepared = Some(shape);
        }
        self.network.run(&self.x[..shape.input_len()], &mut self.y[..shape.output_len()])?;
        let share = since(started) / shape.batch as u64;
        for (i, y) in self.batch.iter().zip(self.y.chunks_exact(y_len)) {
            let job = &mut jobs[*i];
            let started = HostTime::now();
            job.steps.infer_ns = share;
            self.kept.prep(&self.workers, job, self.input_size, self.max_depth_m)?.finish(y, &mut job.out)?;
            job.steps.finish_ns = since(started);
        }
        Ok(())
    }

    /// Checks the images of `job`, and returns the size of the network's input.
    fn check(&self, job: &Job<'_>) -> Result<(usize, usize)> {
        job.color.check()?;
        job.depth.check(&job.color)?;
        job.out.check(job.color.width, job.color.height)?;
        net_size(job.color.width, job.color.height, self.input_size)
    }
}

fn since(started: HostTime) -> u64 {
    u64::try_from(HostTime::now().since_ns(started)).unwrap_or(0)
}

impl Refiner for CdmRefiner {
    fn describe(&self) -> &Description {
        &self.description
    }

    fn best_batch(&self) -> usize {
        self.network.best_batch()
    }

    fn warms_up(&self) -> bool {
        self.network.warms_up()
    }

    fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
        let mut order = core::mem::take(&mut self.order);
        order.clear();
        let of = jobs.len();
        for (i, job) in jobs.iter_mut().enumerate() {
            job.steps = StepTimes::default();
            let net = self.check(job).map_err(|e| match of {
                1 => e,
                _ => Error::new(e.kind(), format!("pair {} of {of}: {e}", i + 1)),
            })?;
            order.push((net, i));
        }
        order.sort_unstable();
        let at_a_time = self.network.best_batch().max(1);
        let mut batches =
            order.chunk_by(|a, b| a.0 == b.0).flat_map(|of_one_size| of_one_size.chunks(at_a_time));
        let done = batches.try_for_each(|batch| self.run(jobs, batch, batch[0].0));
        self.order = order;
        done
    }
}

#[cfg(test)]
mod tests;
