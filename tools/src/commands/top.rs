//! `depthrig top`: the status of the running rig, refreshed in place, with small images where they are wanted.

use crate::context::Context;
use crate::exit::Exit;
use crate::screen::{self, Key, Screen};
use crate::signals::Stop;
use crate::view::{self, Style};
use crate::wall::{self, Area, Means, Wall};
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::{Bus, HostTime};
use depthrig_daemon::client::Client;
use depthrig_daemon::status::RigStatus;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Images are those of kitty's protocol, sixel or half blocks, whichever the terminal answers to first; inside tmux and screen half
blocks. They take at most 1 MB/s, also over ssh. Near depth is red, far depth blue, a hole grey.

Keys: i shows or hides images, q leaves.

Examples:
  depthrig top
  depthrig top --images            the best that the terminal can show
  ssh -t HOST depthrig top --images=blocks";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct TopArgs {
    /// Seconds between refreshes
    #[arg(long, value_name = "S", default_value = "1", value_parser = crate::args::positive_seconds)]
    interval: f64,
    /// Show small images of all streams [default without HOW: auto]
    #[arg(
        long,
        value_name = "HOW",
        num_args = 0..=1,
        require_equals = true,
        default_value = "off",
        default_missing_value = "auto"
    )]
    images: Images,
}

/// How `top` shows images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Images {
    /// The best that the terminal can show
    Auto,
    /// Graphics protocol of kitty
    Kitty,
    /// Sixel graphics
    Sixel,
    /// Half blocks in 24-bit colours
    Blocks,
    /// None, until the key i
    Off,
}

impl Images {
    const fn means(self) -> Option<Means> {
        match self {
            Self::Kitty => Some(Means::Kitty),
            Self::Sixel => Some(Means::Sixel),
            Self::Blocks => Some(Means::Blocks),
            Self::Auto | Self::Off => None,
        }
    }
}

/// Polling interval of keys and signals.
const LOOK: Duration = Duration::from_millis(100);

/// Refreshes until q, Ctrl-C, or the end of the rig.
pub fn run(args: &TopArgs, context: &Context) -> Result<Exit> {
    let client = super::record::connect(context)?;
    let rig = client.status()?; // report an error before taking over the screen
    let stop = Stop::on_signals()?;
    let mut top = Top { screen: Screen::enter()?, client, context, wall: None, size: screen::USUAL, rig };
    if args.images != Images::Off {
        top.show_images(args.images.means())?;
    }
    let mut refresh = HostTime::now();
    loop {
        if refresh.from_now().is_zero() {
            top.refresh()?;
            refresh = HostTime::now().plus(Duration::from_secs_f64(args.interval));
        }
        top.draw_images()?;
        let key = top.screen.key(top.wait().min(refresh.from_now())).and_then(Key::letter);
        if stop.is_asked() || key == Some('q') {
            return Ok(Exit::Good);
        }
        if key == Some('i') {
            top.toggle_images(args.images.means())?;
        }
    }
}

/// The page.
struct Top<'a> {
    screen: Screen,
    client: Client,
    context: &'a Context,
    wall: Option<Wall>,
    size: (usize, usize),
    rig: RigStatus,
}

impl Top<'_> {
    /// Asks the daemon and draws the text.
    fn refresh(&mut self) -> Result<()> {
        self.rig = self.client.status()?;
        if let Some(wall) = &mut self.wall {
            wall.follow(&self.rig);
        }
        self.draw_text()
    }

    fn draw_text(&mut self) -> Result<()> {
        let size = screen::size().unwrap_or(screen::USUAL);
        let is_resized = core::mem::replace(&mut self.size, size) != size;
        let text = view::status(&self.rig, Style { width: size.0, color: self.context.color() });
        let Some(wall) = &mut self.wall else {
            return self.screen.draw(&format!("{text}\n\nq leaves, i shows images"));
        };
        if is_resized {
            self.screen.clear()?;
            wall.forget();
        }
        let area = area(&text, size);
        self.screen.draw_top(&text, area.row - 1)?;
        let hint = view::clip(&format!("q leaves, i hides images; {}", wall.note()), size.0);
        self.screen.put(&format!("\x1b[{};1H{hint}\x1b[K", size.1))
    }

    /// Draws new images, if it is time.
    fn draw_images(&mut self) -> Result<()> {
        let Some(wall) = &mut self.wall else { return Ok(()) };
        if !wall.due_in().is_zero() {
            return Ok(());
        }
        let text = view::status(&self.rig, Style { width: self.size.0, color: false });
        let images = wall.round(area(&text, self.size));
        self.screen.put(&images)
    }

    /// Time until there is something to draw.
    fn wait(&self) -> Duration {
        self.wall.as_ref().map_or(LOOK, |wall| wall.due_in().min(LOOK))
    }

    fn toggle_images(&mut self, means: Option<Means>) -> Result<()> {
        match self.wall.take() {
            Some(wall) => self.screen.put(wall.gone())?,
            None => self.show_images(means)?,
        }
        self.screen.clear()?;
        self.draw_text()
    }

    fn show_images(&mut self, means: Option<Means>) -> Result<()> {
        let runtime = self.context.runtime()?;
        let bus = Bus::open(&runtime, &self.rig.rig.parse()?)?;
        let mut wall = Wall::new(bus, wall::find(&self.screen, means)?);
        wall.follow(&self.rig);
        self.wall = Some(wall);
        Ok(())
    }
}

/// Rows for images: those below the text, at least half of the screen; the last row is for the hint.
fn area(text: &str, (columns, rows): (usize, usize)) -> Area {
    let text = text.lines().count().min(rows / 2);
    Area { row: text + 1, rows: (rows - text).saturating_sub(1), columns }
}
