//! Garbage collection beside a submit: the files of a capture that the store has from long ago, unnamed.
//!
//! The client asks whether the file is there (so it does not send it), puts the manifest, submits. Collections run
//! meanwhile, each operation on the bucket by itself; between two operations a collection may stand still for as long as
//! it likes. Only a client that is between its first question and its submit is faster than the grace.

use crate::explore::World;

/// How garbage is collected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Variant {
    /// As it is: through the trash, from which whoever asks gets things back; young manifests are spared.
    Real,
    /// Broken: what nothing names is deleted at once.
    NoTrash,
    /// Broken: nobody looks into the trash.
    NoRescue,
}

/// Where the file is. It never has to be in one place only.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Places {
    store: bool,
    trash: bool,
    /// What is in the trash has been there for a whole grace.
    expired: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Client {
    Begins,
    /// It was told that the file is there, or sent it.
    HasFile,
    /// The manifest was put: every file was there.
    HasManifest,
    /// Acknowledged: the database names the manifest.
    Submitted,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Collector {
    Rests,
    /// It knows what the database and young manifests name.
    Knows {
        named: bool,
    },
    /// It listed what lies in the store and in the trash.
    Listed {
        in_store: bool,
        expired: bool,
    },
    /// It copied the file into the trash.
    Copied,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Collecting {
    variant: Variant,
    file: Places,
    manifest_is_young: bool,
    client: Client,
    collector: Collector,
    runs_left: u32,
}

impl Collecting {
    pub(crate) fn new(variant: Variant) -> Self {
        Self {
            variant,
            file: Places {
                store: true,
                ..Places::default()
            },
            manifest_is_young: false,
            client: Client::Begins,
            collector: Collector::Rests,
            runs_left: 3,
        }
    }

    fn with(&self, change: impl FnOnce(&mut Self)) -> Self {
        let mut next = *self;
        change(&mut next);
        next
    }

    /// Whether the store has the file, for somebody who asks.
    fn ask(&mut self) -> bool {
        if !self.file.store && self.file.trash && self.variant != Variant::NoRescue {
            self.file = Places {
                store: true,
                ..Places::default()
            };
        }
        self.file.store
    }
}

impl World for Collecting {
    fn steps(&self) -> Vec<(String, Self)> {
        let mut steps = Vec::new();
        let mut step = |name: &str, next: Self| steps.push((name.to_owned(), next));
        match self.client {
            Client::Begins => step(
                "the client asks for the file, and sends it if it is absent",
                self.with(|next| {
                    if !next.ask() {
                        next.file.store = true;
                    }
                    next.client = Client::HasFile;
                }),
            ),
            Client::HasFile => step(
                "the client puts the manifest",
                self.with(|next| {
                    // Refused when a file is absent; then it begins again.
                    next.client = if next.ask() {
                        next.manifest_is_young = true;
                        Client::HasManifest
                    } else {
                        Client::Begins
                    };
                }),
            ),
            Client::HasManifest => step(
                "the client submits",
                self.with(|next| next.client = Client::Submitted),
            ),
            Client::Submitted => {}
        }
        match self.collector {
            Collector::Rests if self.runs_left > 0 => step(
                "a collection learns what is named",
                self.with(|next| {
                    next.runs_left -= 1;
                    next.collector = Collector::Knows {
                        named: next.client == Client::Submitted || next.manifest_is_young,
                    };
                }),
            ),
            Collector::Rests => {}
            Collector::Knows { named } => step(
                "the collection lists store and trash",
                self.with(|next| {
                    next.collector = if named {
                        Collector::Rests
                    } else {
                        Collector::Listed {
                            in_store: next.file.store,
                            expired: next.file.trash && next.file.expired,
                        }
                    };
                }),
            ),
            Collector::Listed { in_store, expired } => step(
                "the collection deletes from the trash, and copies into it",
                self.with(|next| {
                    // The entry that was listed; another one that came since has another name.
                    if expired && next.file.expired {
                        next.file.trash = false;
                        next.file.expired = false;
                    }
                    next.collector = Collector::Rests;
                    if in_store && next.file.store {
                        if next.variant != Variant::NoTrash {
                            next.file.trash = true;
                            next.file.expired = false;
                        }
                        next.collector = Collector::Copied;
                    }
                }),
            ),
            Collector::Copied => step(
                "the collection deletes from the store",
                self.with(|next| {
                    next.file.store = false;
                    next.collector = Collector::Rests;
                }),
            ),
        }
        if matches!(self.client, Client::Begins | Client::Submitted) {
            step(
                "a grace passes",
                self.with(|next| {
                    next.manifest_is_young = false;
                    next.file.expired = next.file.trash;
                }),
            );
        }
        steps
    }

    fn check(&self) -> Result<(), String> {
        if self.client != Client::Submitted {
            return Ok(());
        }
        // What a worker that fetches the capture finds.
        if self.clone().ask() {
            Ok(())
        } else {
            Err("an acknowledged submit names a file that is gone".to_owned())
        }
    }

    fn is_done(&self) -> bool {
        self.client == Client::Submitted && self.collector == Collector::Rests
    }
}
