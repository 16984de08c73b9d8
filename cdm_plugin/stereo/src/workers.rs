//! The worker threads of stereo: one rectifies, one per mode matches, one checks the rows now and then. Pairs go in,
//! rectified images and depth come out.
//!
//! Each thread has a box for one pair; a newer pair takes the place of one that still lies there, unless that is of the
//! moment of a frame set. Image buffers are allocated once and reused.

use super::newest::Newest;
use super::pair::{Raw, Views};
use super::rows::{self, Corrected, Rows};
use super::{Descriptions, Geometry, StereoMode, StereoOptions, has_color};
use core::time::Duration;
use depthrig_bus::PixelFormat;
use depthrig_bus::sync::lock;
use depthrig_calib::stereo::{
    DisparityMap, Gray, Matcher, Order, OrderCheck, StereoPair, depth_from_disparity,
};
use depthrig_calib::{Rectifier, View};
use depthrig_driver::{Error, ErrorKind, Result};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

/// Nice value of the workers: below the capture threads and threads with deadlines.
const NICE: i32 = 10;
/// Consecutive pairs that must look swapped before it is believed.
const BELIEVED: u32 = 3;
/// Pairs from one check of left against right to the next, after the first.
const LOOK_EVERY: u64 = 100;
/// Results of one mode that may be on their way at once.
const PRODUCTS: usize = 2;

/// A mode's result for a pair.
#[derive(Debug, Default)]
pub(super) struct Product {
    pub(super) ticket: u64,
    pub(super) map: DisparityMap,
    pub(super) depth: Vec<u16>,
}

/// A report of a worker.
#[derive(Debug)]
pub(super) enum Event {
    /// A pair is rectified.
    Rectified(Arc<Views>),
    /// Mode number .0 has matched a pair.
    Matched(usize, Product),
    /// Mode number .0 gave the pair .1 up for another one.
    Skipped(usize, u64),
    /// Mode number .0 failed at the pair .1.
    Failed(usize, u64, String),
    /// Left and right are swapped.
    Swapped,
}

/// The workers of one camera. Dropping it ends them when they are done with what they work on; it does not wait.
pub(super) struct Workers {
    raw: Arc<Newest<Raw>>,
    /// Used images, for the next pair.
    spare: Vec<Raw>,
    spared: Receiver<Raw>,
    views: Vec<Arc<Newest<Arc<Views>>>>,
    rows: Arc<Newest<Arc<Views>>>,
    events: Receiver<Event>,
    /// Where each mode's products go back.
    back: Vec<SyncSender<Product>>,
}

impl Workers {
    /// Makes every matcher, then starts the threads.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a mode's matcher cannot be made, [`ErrorKind::Io`] when the system refuses a
    /// thread.
    pub(super) fn start(
        camera: &str,
        rectifier: Rectifier,
        format: PixelFormat,
        options: &StereoOptions,
    ) -> Result<Self> {
        let (width, height) = rectifier.size();
        let geometry = Geometry {
            width: width as usize,
            height: height as usize,
            focal_px: rectifier.intrinsics().fx,
            baseline_m: rectifier.baseline_m(),
        };
        let made = |m| make(camera, m, &geometry, &options.computed);
        let matchers = options.modes.iter().map(made).collect::<Result<Vec<_>>>()?;
        // Every pair that is on its way can say something to each mode, and once more.
        let (send, events) = sync_channel(8 * (matchers.len() + 1));
        let (spare, spared) = sync_channel(4);
        let raw = Newest::new(options.every_pair);
        let views: Vec<_> = matchers.iter().map(|_| Newest::new(options.every_pair)).collect();
        let order = OrderCheck::new(geometry.width, geometry.height)
            .map_err(|e| Error::new(ErrorKind::BadInput, format!("{camera}: {e}")).with_source(e))?;
        let rows = Newest::new(options.every_pair);
        let corrected = Arc::new(Corrected::default());
        let look = Rows::new(camera, &rectifier, &rows, &corrected, options);
        spawn(camera, "rows", move || look.run())?;
        let rectify = Rectify {
            rectifier,
            corrected,
            corrections: 0,
            format,
            wants_color: options.modes.iter().any(|m| m.wants_color),
            input: Arc::clone(&raw),
            spare,
            outputs: views.clone(),
            rows: Arc::clone(&rows),
            events: send.clone(),
            pool: Vec::new(),
            most: matchers.len() + 6,
            order,
            pairs: 0,
            swapped: 0,
        };
        spawn(camera, "rectify", move || rectify.run())?;
        let mut back = Vec::new();
        for (i, (matcher, mode)) in matchers.into_iter().zip(&options.modes).enumerate() {
            let (give, free) = sync_channel(PRODUCTS);
            for _ in 0..PRODUCTS {
                // There is room for all of them.
                let _ = give.try_send(Product::default());
            }
            back.push(give);
            let work = Match {
                number: i,
                matcher,
                geometry,
                unit_m: options.depth_unit_m,
                range_m: options.range_m,
                input: Arc::clone(&views[i]),
                free,
                events: send.clone(),
            };
            spawn(camera, &mode.name, move || work.run())?;
        }
        Ok(Self { raw, spare: Vec::new(), spared, views, rows, events, back })
    }

    /// Memory for the images of a pair.
    pub(super) fn blank(&mut self) -> Raw {
        self.spared.try_recv().ok().or_else(|| self.spare.pop()).unwrap_or_default()
    }

    /// Hands a pair on. Returns the ticket of the superseded one: an older one, or this.
    pub(super) fn offer(&mut self, raw: Raw) -> Option<u64> {
        let old = self.raw.put(raw)?;
        let ticket = old.ticket;
        self.spare.push(old);
        Some(ticket)
    }

    /// The next report, waiting for at most `timeout`.
    pub(super) fn next(&self, timeout: Duration) -> Option<Event> {
        if timeout.is_zero() { self.events.try_recv().ok() } else { self.events.recv_timeout(timeout).ok() }
    }

    /// Gives the product of mode `number` back.
    pub(super) fn give_back(&self, number: usize, product: Product) {
        // There is room for every product that there is.
        let _ = self.back.get(number).map(|b| b.try_send(product));
    }
}

impl Drop for Workers {
    fn drop(&mut self) {
        self.raw.close();
        self.views.iter().for_each(|v| v.close());
        self.rows.close();
    }
}

fn make(
    camera: &str,
    mode: &StereoMode,
    geometry: &Geometry,
    computed: &Descriptions,
) -> Result<Box<dyn Matcher>> {
    let matcher = (mode.make)(geometry).map_err(|e| {
        let what = format!("{camera}: the stereo mode \"{}\" cannot be made: {e}", mode.name);
        Error::new(ErrorKind::BadInput, what).with_source(e)
    })?;
    let d = matcher.describe();
    let mode = &mode.name;
    let mib = d.memory_bytes / (1 << 20);
    tracing::info!(camera, mode, producer = d.producer, parameters = d.parameters, mib, "stereo");
    lock(computed).insert(mode.clone(), d);
    Ok(matcher)
}

fn spawn(camera: &str, name: &str, work: impl FnOnce() + Send + 'static) -> Result<()> {
    let lowered = move || {
        // Of this thread alone on Linux; refused, it is merely as urgent as others.
        if let Err(e) = rustix::process::nice(NICE) {
            tracing::debug!(error = %e, "a stereo thread keeps its priority");
        }
        work();
    };
    let thread = std::thread::Builder::new().name(format!("st-{name}")).spawn(lowered);
    thread.map(drop).map_err(|e| {
        Error::new(ErrorKind::Io, format!("{camera}: no thread for stereo could be started")).with_source(e)
    })
}

/// The thread that rectifies.
struct Rectify {
    rectifier: Rectifier,
    /// The next one, with rows that were found to be apart put together.
    corrected: Arc<Corrected>,
    corrections: u64,
    format: PixelFormat,
    wants_color: bool,
    input: Arc<Newest<Raw>>,
    spare: SyncSender<Raw>,
    outputs: Vec<Arc<Newest<Arc<Views>>>>,
    /// For whoever looks at the rows.
    rows: Arc<Newest<Arc<Views>>>,
    events: SyncSender<Event>,
    /// All views that there are; those that nobody else has are free.
    pool: Vec<Arc<Views>>,
    most: usize,
    order: OrderCheck,
    pairs: u64,
    /// Consecutive pairs that look swapped.
    swapped: u32,
}

impl Rectify {
    fn run(mut self) {
        while let Some(raw) = self.input.take() {
            let Some(mut views) = self.free() else { return };
            if let Some(rectifier) = self.corrected.take() {
                self.rectifier = rectifier;
                self.corrections += 1;
            }
            if let Some(v) = Arc::get_mut(&mut views) {
                self.fill(&raw, v);
            }
            if self.look(&views) && self.events.send(Event::Swapped).is_err() {
                return;
            }
            if rows::is_looked_at(self.pairs) {
                // A superseded one is not a loss.
                drop(self.rows.put(Arc::clone(&views)));
            }
            let matched = raw.matched;
            // When the camera is given up, nobody takes it any more.
            let _ = self.spare.try_send(raw);
            for (i, output) in self.outputs.iter().enumerate().filter(|_| matched) {
                if let Some(old) = output.put(Arc::clone(&views))
                    && self.events.send(Event::Skipped(i, old.ticket)).is_err()
                {
                    return;
                }
            }
            self.pool.push(Arc::clone(&views));
            if self.events.send(Event::Rectified(views)).is_err() {
                return;
            }
        }
    }

    /// Checks now and then whether left and right are swapped.
    fn look(&mut self, views: &Views) -> bool {
        self.pairs += 1;
        if self.swapped == 0 && self.pairs % LOOK_EVERY != 1 {
            return false;
        }
        let (width, height) = self.rectifier.size();
        let gray = |image| Gray::packed(image, width as usize, height as usize);
        match self.order.check(&StereoPair::new(gray(&views.left), gray(&views.right))) {
            Ok(Order::Swapped) => self.swapped += 1,
            _ => self.swapped = 0,
        }
        self.swapped == BELIEVED
    }

    /// Views that nobody has. There always are some: each mode has one at most that it works on, one waits for all of
    /// them, and those that were reported are taken soon.
    fn free(&mut self) -> Option<Arc<Views>> {
        loop {
            if let Some(i) = self.pool.iter().position(|v| Arc::strong_count(v) == 1) {
                return Some(self.pool.swap_remove(i));
            }
            if self.pool.len() < self.most {
                return Some(Arc::default());
            }
            if self.input.is_closed() {
                return None;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn fill(&self, raw: &Raw, views: &mut Views) {
        let (width, height) = self.rectifier.size();
        let pixels = width as usize * height as usize;
        let r = &self.rectifier;
        let color = has_color(self.format);
        (views.ticket, views.due) = (raw.ticket, raw.due);
        views.corrections = self.corrections;
        views.left.resize(pixels, 0);
        views.right.resize(pixels, 0);
        views.left_rgb.resize(if color { 3 * pixels } else { 0 }, 0);
        views.right_rgb.resize(if color && self.wants_color { 3 * pixels } else { 0 }, 0);
        let images = [
            (View::Left, &raw.left, &mut views.left, &mut views.left_rgb),
            (View::Right, &raw.right, &mut views.right, &mut views.right_rgb),
        ];
        for (view, image, grey, rgb) in images {
            let rgb = Some(rgb.as_mut_slice()).filter(|rgb| !rgb.is_empty());
            let done = r.rectify(view, self.format, image, grey, rgb);
            // The sizes were checked when the camera was started and when the images came.
            if let Err(e) = done {
                tracing::error!(error = %e, "an image was not rectified");
            }
        }
    }
}

/// The thread of a mode.
struct Match {
    number: usize,
    matcher: Box<dyn Matcher>,
    geometry: Geometry,
    unit_m: f64,
    range_m: (f64, f64),
    input: Arc<Newest<Arc<Views>>>,
    free: Receiver<Product>,
    events: SyncSender<Event>,
}

impl Match {
    fn run(mut self) {
        let mut kept: Option<Product> = None;
        while let Some(views) = self.input.take() {
            // Both products are on their way: whoever takes them gives one back soon, or is gone.
            let Some(mut product) = kept.take().or_else(|| self.free.recv().ok()) else { return };
            let number = self.number;
            let ticket = views.ticket;
            let done = self.run_one(&views, &mut product);
            drop(views);
            let event = match done {
                Ok(()) => Event::Matched(number, product),
                Err(e) => {
                    kept = Some(product);
                    Event::Failed(number, ticket, e.to_string())
                }
            };
            if self.events.send(event).is_err() {
                return;
            }
        }
    }

    fn run_one(&mut self, views: &Views, product: &mut Product) -> depthrig_calib::Result<()> {
        let Geometry { width, height, focal_px, baseline_m } = self.geometry;
        let rgb = |image: &'_ Vec<u8>| !image.is_empty();
        let pair = StereoPair {
            left: Gray::packed(&views.left, width, height),
            right: Gray::packed(&views.right, width, height),
            left_rgb: Some(views.left_rgb.as_slice()).filter(|_| rgb(&views.left_rgb)),
            right_rgb: Some(views.right_rgb.as_slice()).filter(|_| rgb(&views.right_rgb)),
        };
        product.ticket = views.ticket;
        self.matcher.run(&pair, &mut product.map)?;
        product.depth.resize(width * height, 0);
        let Product { map, depth, .. } = product;
        depth_from_disparity(&map.disparity, focal_px, baseline_m, self.unit_m, self.range_m, depth)?;
        // No depth, no confidence in it.
        map.confidence.iter_mut().zip(depth).filter(|(_, z)| **z == 0).for_each(|(c, _)| *c = 0);
        Ok(())
    }
}
