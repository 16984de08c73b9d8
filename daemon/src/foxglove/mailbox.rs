//! Messages that wait for one client: of each channel the newest, and images only as many as the client draws.
//!
//! An image is on its way from the moment in which it is encoded until the client has answered the ping that follows it. At the most [`IMAGES`] are, one of a
//! channel, and no more than [`IMAGE_BYTES`] together. So a client that does not read costs this much and no more, and when it comes back it has this
//! many old images to read.

use hyper::body::Bytes;
use std::collections::{BTreeMap, VecDeque};

/// Images that may be on their way to a client.
pub(super) const IMAGES: usize = 4;
/// Their bytes; a single image may have more.
pub(super) const IMAGE_BYTES: usize = 8 << 20;
/// Lines about problems that may wait.
const PROBLEMS: usize = 8;

/// Messages for one client.
#[derive(Debug, Default)]
pub(super) struct Mailbox {
    /// Of each small channel: the newest message, or the newest batch of an IMU.
    small: BTreeMap<u32, Vec<Bytes>>,
    /// Images that wait for the connection, oldest first.
    images: VecDeque<Image>,
    /// Images that the client has not drawn yet, those that wait included.
    on_the_way: Vec<OnTheWay>,
    /// Number of the newest image.
    newest: u64,
    problems: VecDeque<String>,
}

#[derive(Debug)]
struct Image {
    number: u64,
    channel: u32,
    bytes: Bytes,
}

#[derive(Debug)]
struct OnTheWay {
    number: u64,
    channel: u32,
    bytes: usize,
}

/// What is sent next.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Next {
    /// Small messages.
    Small(Vec<Bytes>),
    /// An image; a ping with this number follows it.
    Image {
        /// The number.
        number: u64,
        /// The message.
        bytes: Bytes,
    },
    /// Why something is not shown.
    Problem(String),
}

impl Mailbox {
    /// Puts in the newest messages of a small channel; those that wait are replaced.
    pub(super) fn put_small(&mut self, channel: u32, messages: Vec<Bytes>) {
        self.small.insert(channel, messages);
    }

    /// Whether an image of `bytes` may be sent on this channel.
    pub(super) fn takes_image(&self, channel: u32, bytes: usize) -> bool {
        let waiting: usize = self.on_the_way.iter().map(|i| i.bytes).sum();
        self.on_the_way.is_empty()
            || (self.on_the_way.len() < IMAGES
                && waiting.saturating_add(bytes) <= IMAGE_BYTES
                && self.on_the_way.iter().all(|i| i.channel != channel))
    }

    /// Puts in an image.
    pub(super) fn put_image(&mut self, channel: u32, bytes: Bytes) {
        self.newest += 1;
        let number = self.newest;
        self.on_the_way.push(OnTheWay { number, channel, bytes: bytes.len() });
        self.images.push_back(Image { number, channel, bytes });
    }

    /// Puts in a line for the client; the same line waits once.
    pub(super) fn put_problem(&mut self, problem: String) {
        if self.problems.len() < PROBLEMS && !self.problems.contains(&problem) {
            self.problems.push_back(problem);
        }
    }

    /// The client has drawn all images up to this one.
    pub(super) fn drawn(&mut self, number: u64) {
        let is_unsent = |i: &OnTheWay| self.images.front().is_some_and(|first| i.number >= first.number);
        self.on_the_way.retain(|i| i.number > number || is_unsent(i));
    }

    /// Forgets what waits on a channel.
    pub(super) fn forget(&mut self, channel: u32) {
        self.small.remove(&channel);
        self.images.retain(|image| {
            let stays = image.channel != channel;
            if !stays {
                self.on_the_way.retain(|i| i.number != image.number);
            }
            stays
        });
    }

    /// What is sent next: small messages go before images.
    pub(super) fn next(&mut self) -> Option<Next> {
        if let Some(problem) = self.problems.pop_front() {
            return Some(Next::Problem(problem));
        }
        if !self.small.is_empty() {
            let all = core::mem::take(&mut self.small);
            return Some(Next::Small(all.into_values().flatten().collect()));
        }
        self.images.pop_front().map(|image| Next::Image { number: image.number, bytes: image.bytes })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(n: usize) -> Bytes {
        vec![n as u8; n].into()
    }

    #[test]
    fn the_newest_small_message_wins_and_goes_before_images() {
        let mut mailbox = Mailbox::default();
        mailbox.put_image(1, bytes(9));
        mailbox.put_small(2, vec![bytes(1)]);
        mailbox.put_small(2, vec![bytes(2), bytes(3)]);
        assert_eq!(mailbox.next(), Some(Next::Small(vec![bytes(2), bytes(3)])));
        assert_eq!(mailbox.next(), Some(Next::Image { number: 1, bytes: bytes(9) }));
        assert_eq!(mailbox.next(), None);
    }

    #[test]
    fn an_image_is_on_its_way_until_its_pong() {
        let mut mailbox = Mailbox::default();
        mailbox.put_image(1, bytes(9));
        assert!(!mailbox.takes_image(1, 1) && mailbox.takes_image(2, 1));
        mailbox.drawn(1);
        assert!(!mailbox.takes_image(1, 1), "a pong before the image was sent");
        mailbox.next();
        assert!(!mailbox.takes_image(1, 1), "sent and not drawn");
        mailbox.drawn(0);
        assert!(!mailbox.takes_image(1, 1), "an older pong");
        mailbox.drawn(1);
        assert!(mailbox.takes_image(1, 1));
    }

    #[test]
    fn few_images_and_few_bytes_are_on_their_way() {
        let mut mailbox = Mailbox::default();
        for channel in 0..IMAGES as u32 {
            assert!(mailbox.takes_image(channel, 10));
            mailbox.put_image(channel, bytes(10));
        }
        assert!(!mailbox.takes_image(99, 10), "as many as may");
        let mut mailbox = Mailbox::default();
        assert!(mailbox.takes_image(1, IMAGE_BYTES + 1), "a large one alone");
        mailbox.put_image(1, bytes(IMAGE_BYTES / 2));
        assert!(mailbox.takes_image(2, IMAGE_BYTES / 2) && !mailbox.takes_image(2, IMAGE_BYTES / 2 + 1));
    }

    #[test]
    fn what_is_not_watched_any_more_is_forgotten() {
        let mut mailbox = Mailbox::default();
        mailbox.put_small(1, vec![bytes(1)]);
        mailbox.put_image(1, bytes(2));
        mailbox.put_image(2, bytes(3));
        mailbox.forget(1);
        assert!(mailbox.takes_image(1, 1) && !mailbox.takes_image(2, 1));
        assert_eq!(mailbox.next(), Some(Next::Image { number: 2, bytes: bytes(3) }));
        for _ in 0..100 {
            mailbox.put_problem("x".into());
        }
        assert_eq!(mailbox.next(), Some(Next::Problem("x".into())));
        assert_eq!(mailbox.next(), None);
    }
}
