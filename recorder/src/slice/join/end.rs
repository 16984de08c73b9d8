//! Losses after the last set, and losses without a known reason.

use super::{Head, Join};
use crate::slice::output::{Losses, Output};
use crate::slice::session::{
    AFTER, BEFORE, UNEXPLAINED, is_between, is_same_end, is_whole_end, last_account, lost_in_words,
};
use crate::slice::track::Input;

impl Join<'_> {
    /// Takes what happened after the last set, and what the inputs say in words.
    pub(super) fn end(&mut self, heads: &mut [Head], output: &Output<'_>) {
        let Some((first, last)) = output.first.zip(output.last) else { return };
        if self.range.ends {
            self.after(heads, last.0, last.1);
        }
        self.unexplained += heads.iter().map(|h| h.books.unexplained()).sum::<u64>();
        if self.unexplained > 0 {
            let n = self.unexplained;
            self.lose(format!("{n} sets are not there, {UNEXPLAINED}"));
        }
        self.say_unread(first.1 as i64, last.1 as i64, output.offered_before() == 0);
        self.repeat_words(first.0, last.0);
    }

    /// Takes what happened after the last set, of this id and time, from the tracks that end with it.
    fn after(&mut self, heads: &mut [Head], id: u64, log_time: u64) {
        let inputs = self.inputs;
        let mut ended: Vec<_> = heads.iter_mut().filter(|head| head.ends_with(id)).collect();
        for head in &mut ended {
            head.close(inputs, &mut self.losses);
        }
        // All of them count the same losses, but one whose accounts begin late may not know of each.
        if let Some(head) = ended.iter_mut().max_by_key(|head| head.books.beyond_gaps()) {
            head.books.end(&mut self.losses);
        }
        let whole = |head: &&mut Head| head.damage.is_empty() && head.has_whole_end(inputs, log_time as i64);
        if ended.iter().any(whole) {
            return;
        }
        let damage: Vec<_> = ended.iter_mut().flat_map(|head| std::mem::take(&mut head.damage)).collect();
        if !damage.is_empty() {
            self.lose(format!("{AFTER}{id} is not there: {}", damage.join("; ")));
        }
    }

    /// Says which inputs cannot be read, unless all of their sets lie between the first and the last one: what
    /// is missing there is said already.
    fn say_unread(&mut self, first_utc_ns: i64, last_utc_ns: i64, begins: bool) {
        for (input, why) in std::mem::take(&mut self.unread) {
            let dataset = self.inputs[input].dataset;
            if !is_between(dataset.session(), first_utc_ns, last_utc_ns, begins) {
                self.lose(format!("what {} holds is not there: {why}", dataset.path().display()));
            }
        }
    }

    /// Says once more what the inputs say of the ends that the new dataset has.
    fn repeat_words(&mut self, first: u64, last: u64) {
        for input in self.inputs {
            for line in lost_in_words(input.dataset.session(), first, last) {
                let wanted = if line.starts_with(BEFORE) { self.range.begins } else { self.range.ends };
                let again = self.lost.iter().any(|l| *l == line || is_same_end(l, &line));
                if wanted && !again {
                    self.lose(line);
                }
            }
        }
    }
}

impl Head {
    /// Whether its last set is this one.
    fn ends_with(&self, id: u64) -> bool {
        !self.beyond && self.before.is_some_and(|(before, ..)| before.id == id)
    }

    /// Takes how its dataset ended, as that says itself.
    fn close(&mut self, inputs: &[Input<'_>], losses: &mut Losses) {
        let Some(source) = &self.source else { return };
        let dataset = inputs[source.origin.input].dataset;
        // A segment on its own does not say how its recording ended.
        if !dataset.is_folder() {
            return;
        }
        match &dataset.session().outcome {
            Some(outcome) => self.books.account(&last_account(outcome), losses),
            None if self.damage.is_empty() => {
                let path = dataset.path().display();
                self.damage.push(format!("the recording {path} was not closed"));
            }
            None => {}
        }
    }

    /// Whether nothing came after its last set, which is of this time.
    fn has_whole_end(&self, inputs: &[Input<'_>], utc_ns: i64) -> bool {
        let dataset = self.source.as_ref().map(|s| inputs[s.origin.input].dataset);
        dataset.is_some_and(|d| d.is_folder() && is_whole_end(d.session(), utc_ns))
    }
}
