//! Messages that wait for one client: of each channel the newest, and no more than the client takes in.
//!
//! A ping follows each thing that is sent. Until the client has answered it, the thing is on its way: at the most [`IMAGES`] images, one of a channel, no more
//! than [`IMAGE_BYTES`] together; and [`BUNDLES`] bundles of small messages. So a client that does not read costs this much and no more, and when it
//! comes back it has this many old messages to read.

use hyper::body::Bytes;
use std::collections::{BTreeMap, VecDeque};

/// Images that may be on their way to a client.
pub(super) const IMAGES: usize = 4;
/// Their bytes; a single image may have more.
pub(super) const IMAGE_BYTES: usize = 8 << 20;
/// Bundles of small messages that may be on their way; a browser may take 0.1 s to answer, and batches of an IMU come more often.
const BUNDLES: usize = 16;
/// Lines about problems that may wait.
const PROBLEMS: usize = 8;

/// Messages for one client.
#[derive(Debug, Default)]
pub(super) struct Mailbox {
    /// Of each small channel: the newest message, or the newest batch of an IMU.
    small: BTreeMap<u32, Vec<Bytes>>,
    /// Numbers of the bundles that the client has not answered.
    bundles: Vec<u64>,
    /// Images that wait for the connection, oldest first.
    waiting: VecDeque<Waiting>,
    /// Images that the client has not answered, those that wait included.
    images: Vec<OnTheWay>,
    /// Number of the newest ping.
    newest: u64,
    problems: VecDeque<String>,
    /// Lines that found no room.
    left_out: u64,
}

#[derive(Debug)]
struct Waiting {
    channel: u32,
    bytes: Bytes,
}

#[derive(Debug)]
struct OnTheWay {
    channel: u32,
    bytes: usize,
    /// Number of the ping behind it; `None` while it waits.
    sent: Option<u64>,
}

/// The next thing to send; a ping with its number follows.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Next {
    /// The number.
    pub number: u64,
    /// The thing.
    pub content: Content,
}

/// A thing to send.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Content {
    /// Messages of channels.
    Messages(Vec<Bytes>),
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
        let on_the_way: usize = self.images.iter().map(|i| i.bytes).sum();
        self.images.is_empty()
            || (self.images.len() < IMAGES
                && on_the_way.saturating_add(bytes) <= IMAGE_BYTES
                && self.images.iter().all(|i| i.channel != channel))
    }

    /// Puts in an image.
    pub(super) fn put_image(&mut self, channel: u32, bytes: Bytes) {
        self.images.push(OnTheWay { channel, bytes: bytes.len(), sent: None });
        self.waiting.push_back(Waiting { channel, bytes });
    }

    /// Puts in a line for the client; the same line waits once.
    pub(super) fn put_problem(&mut self, problem: String) {
        if self.problems.contains(&problem) {
            return;
        }
        if self.problems.len() < PROBLEMS {
            self.problems.push_back(problem);
        } else {
            self.left_out += 1;
        }
    }

    /// The next line, the last of which says how many are missing.
    fn problem(&mut self) -> Option<String> {
        self.problems.pop_front().or_else(|| match core::mem::take(&mut self.left_out) {
            0 => None,
            n => Some(format!("{n} lines more were left out: they come faster than this viewer reads")),
        })
    }

    /// The client has answered this ping, so it has read everything before.
    pub(super) fn answered(&mut self, number: u64) {
        self.images.retain(|i| i.sent.is_none_or(|sent| sent > number));
        self.bundles.retain(|sent| *sent > number);
    }

    /// Forgets what waits on a channel.
    pub(super) fn forget(&mut self, channel: u32) {
        self.small.remove(&channel);
        self.waiting.retain(|image| image.channel != channel);
        self.images.retain(|i| i.channel != channel || i.sent.is_some());
    }

    /// The next thing to send: small messages go before images.
    pub(super) fn next(&mut self) -> Option<Next> {
        let number = self.newest + 1;
        let content = if let Some(problem) = self.problem() {
            Content::Problem(problem)
        } else if !self.small.is_empty() && self.bundles.len() < BUNDLES {
            self.bundles.push(number);
            Content::Messages(core::mem::take(&mut self.small).into_values().flatten().collect())
        } else {
            let image = self.waiting.pop_front()?;
            if let Some(i) = self.images.iter_mut().find(|i| i.channel == image.channel && i.sent.is_none()) {
                i.sent = Some(number);
            }
            Content::Messages(vec![image.bytes])
        };
        self.newest = number;
        Some(Next { number, content })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(n: usize) -> Bytes {
        vec![n as u8; n].into()
    }

    fn messages(number: u64, of: &[usize]) -> Next {
        Next { number, content: Content::Messages(of.iter().map(|n| bytes(*n)).collect()) }
    }

    #[test]
    fn the_newest_small_message_wins_and_goes_before_images() {
        let mut mailbox = Mailbox::default();
        mailbox.put_image(1, bytes(9));
        mailbox.put_small(2, vec![bytes(1)]);
        mailbox.put_small(2, vec![bytes(2), bytes(3)]);
        assert_eq!(mailbox.next(), Some(messages(1, &[2, 3])));
        assert_eq!(mailbox.next(), Some(messages(2, &[9])));
        assert_eq!(mailbox.next(), None);
    }

    #[test]
    fn an_image_is_on_its_way_until_its_pong() {
        let mut mailbox = Mailbox::default();
        mailbox.put_image(1, bytes(9));
        assert!(!mailbox.takes_image(1, 1) && mailbox.takes_image(2, 1));
        mailbox.answered(1);
        assert!(!mailbox.takes_image(1, 1), "a pong before the image was sent");
        mailbox.put_small(3, vec![bytes(1)]);
        mailbox.next();
        mailbox.next();
        assert!(!mailbox.takes_image(1, 1), "sent and not read");
        mailbox.answered(1);
        assert!(!mailbox.takes_image(1, 1), "the pong of the small message before");
        mailbox.answered(2);
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
    fn who_does_not_answer_gets_few_small_messages_and_then_the_newest() {
        let mut mailbox = Mailbox::default();
        let mut sent = 0;
        for n in 1..100 {
            mailbox.put_small(1, vec![bytes(n)]);
            sent += usize::from(mailbox.next().is_some());
        }
        assert_eq!(sent, BUNDLES);
        mailbox.put_image(2, bytes(7));
        assert_eq!(mailbox.next(), Some(messages(BUNDLES as u64 + 1, &[7])), "an image is not held up");
        mailbox.answered(BUNDLES as u64 - 1);
        assert_eq!(mailbox.next(), Some(messages(BUNDLES as u64 + 2, &[99])));
    }

    #[test]
    fn what_is_not_watched_any_more_is_forgotten() {
        let mut mailbox = Mailbox::default();
        mailbox.put_small(1, vec![bytes(1)]);
        mailbox.put_image(1, bytes(2));
        mailbox.put_image(2, bytes(3));
        mailbox.forget(1);
        assert!(mailbox.takes_image(1, 1) && !mailbox.takes_image(2, 1));
        assert_eq!(mailbox.next(), Some(messages(1, &[3])));
        for _ in 0..100 {
            mailbox.put_problem("x".into());
        }
        assert_eq!(mailbox.next(), Some(Next { number: 2, content: Content::Problem("x".into()) }));
        assert_eq!(mailbox.next(), None);
    }

    #[test]
    fn lines_without_room_are_counted_and_the_count_is_told() {
        let mut mailbox = Mailbox::default();
        for n in (0..PROBLEMS + 3).chain(0..2) {
            mailbox.put_problem(n.to_string());
        }
        let mut lines = Vec::new();
        while let Some(Next { content: Content::Problem(line), .. }) = mailbox.next() {
            lines.push(line);
        }
        assert_eq!(lines.len(), PROBLEMS + 1);
        assert!(lines[PROBLEMS].starts_with("3 lines more"), "{lines:?}");
    }
}
