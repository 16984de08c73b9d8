//! Items of several sources that wait for the next set: IMU batches and samples of signals.

use std::collections::VecDeque;

/// Queues with a limit each; the oldest items are dropped.
pub(super) struct Waiting<T> {
    queues: Vec<Queue<T>>,
    /// Items that came so far.
    came: u64,
}

struct Queue<T> {
    items: VecDeque<Item<T>>,
    weight: u64,
    /// The most that may wait; one item may always.
    most: u64,
}

struct Item<T> {
    /// Its place among all that came.
    number: u64,
    weight: u64,
    value: T,
}

impl<T> Waiting<T> {
    pub(super) const fn new() -> Self {
        Self { queues: Vec::new(), came: 0 }
    }

    /// Adds a source of which items of this weight may wait.
    pub(super) fn add_source(&mut self, most: u64) {
        self.queues.push(Queue { items: VecDeque::new(), weight: 0, most });
    }

    /// Appends an item; the number of older ones that were dropped for it.
    pub(super) fn push(&mut self, source: usize, weight: u64, item: T) -> u64 {
        let Some(queue) = self.queues.get_mut(source) else { return 0 };
        self.came += 1;
        queue.items.push_back(Item { number: self.came, weight, value: item });
        queue.weight = queue.weight.saturating_add(weight);
        queue.shrink()
    }

    /// Changes the limit of a source; the number of items that were dropped.
    pub(super) fn limit(&mut self, source: usize, most: u64) -> u64 {
        let Some(queue) = self.queues.get_mut(source) else { return 0 };
        queue.most = most;
        queue.shrink()
    }

    /// The weight of items of a source that may wait.
    #[cfg(test)]
    pub(super) fn most(&self, source: usize) -> u64 {
        self.queues[source].most
    }

    /// Items of a source that wait.
    pub(super) fn count(&self, source: usize) -> usize {
        self.queues.get(source).map_or(0, |queue| queue.items.len())
    }

    /// Takes the items of a source, oldest first.
    pub(super) fn take(&mut self, source: usize) -> impl Iterator<Item = T> + use<T> {
        let items = self.queues.get_mut(source).map(Queue::take);
        items.into_iter().flatten().map(|i| i.value)
    }

    /// Takes the items of all sources in the order in which they came.
    pub(super) fn take_all(&mut self) -> Vec<T> {
        let mut items: Vec<_> = self.queues.iter_mut().flat_map(Queue::take).collect();
        items.sort_unstable_by_key(|i| i.number);
        items.into_iter().map(|i| i.value).collect()
    }
}

impl<T> Queue<T> {
    fn take(&mut self) -> VecDeque<Item<T>> {
        self.weight = 0;
        core::mem::take(&mut self.items)
    }

    fn shrink(&mut self) -> u64 {
        let mut gone = 0;
        while self.weight > self.most && self.items.len() > 1 {
            let Some(oldest) = self.items.pop_front() else { break };
            self.weight -= oldest.weight;
            gone += 1;
        }
        gone
    }
}
