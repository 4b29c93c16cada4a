//! The wire contract only grows: a worker or client one version older or newer is understood.
//!
//! `tests/frozen/VERSION` holds the contract as that version was released; it is never edited. With the next release the
//! contract of that release is added.

#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use prost::Message as _;
use prost_types::{DescriptorProto, EnumDescriptorProto, FileDescriptorSet};

fn compile(root: &Path) -> FileDescriptorSet {
    let compiled = protox::compile(["ign/v1/ign.proto"], [root]).unwrap();
    FileDescriptorSet::decode(compiled.encode_to_vec().as_slice()).unwrap()
}

fn current() -> FileDescriptorSet {
    FileDescriptorSet::decode(ign_proto::v1::FILE_DESCRIPTOR_SET).unwrap()
}

/// Everything that a peer of another version relies on, one line each.
fn facts(set: &FileDescriptorSet) -> BTreeSet<String> {
    let mut facts = BTreeSet::new();
    for file in set.file.iter().filter(|file| file.package() == "ign.v1") {
        for message in &file.message_type {
            of_message(message.name(), message, &mut facts);
        }
        for one in &file.enum_type {
            of_enum(one.name(), one, &mut facts);
        }
        for service in &file.service {
            for method in &service.method {
                facts.insert(format!(
                    "rpc {}.{} {} {} -> {} {}",
                    service.name(),
                    method.name(),
                    method.input_type(),
                    method.client_streaming(),
                    method.output_type(),
                    method.server_streaming()
                ));
            }
        }
    }
    facts
}

fn of_message(name: &str, message: &DescriptorProto, facts: &mut BTreeSet<String>) {
    for field in &message.field {
        let oneof = field
            .oneof_index
            .map(|index| message.oneof_decl[index as usize].name());
        facts.insert(format!(
            "field {name} {} = {}: {:?} {:?} {} {oneof:?}",
            field.number(),
            field.name(),
            field.label(),
            field.r#type(),
            field.type_name(),
        ));
    }
    for nested in &message.nested_type {
        of_message(&format!("{name}.{}", nested.name()), nested, facts);
    }
    for nested in &message.enum_type {
        of_enum(&format!("{name}.{}", nested.name()), nested, facts);
    }
}

fn of_enum(name: &str, one: &EnumDescriptorProto, facts: &mut BTreeSet<String>) {
    for value in &one.value {
        facts.insert(format!(
            "value {name} {} = {}",
            value.number(),
            value.name()
        ));
    }
}

#[test]
fn every_released_contract_still_holds() {
    let frozen = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/frozen");
    let now = facts(&current());
    let mut released = 0;
    for version in std::fs::read_dir(frozen).unwrap() {
        let root = version.unwrap().path();
        let before = facts(&compile(&root));
        assert!(before.len() > 100, "{} facts", before.len());
        let broken: Vec<&String> = before.difference(&now).collect();
        assert!(broken.is_empty(), "{}: {broken:#?}", root.display());
        released += 1;
    }
    assert!(released > 0);
}

#[test]
fn a_change_of_the_contract_is_noticed() {
    let released = include_str!("frozen/0.1.0/ign/v1/ign.proto");
    for (from, to) in [
        (
            "uint32 attempt = 2;\n  JobSpec spec = 3;",
            "uint32 attempt = 9;\n  JobSpec spec = 3;",
        ),
        ("rpc Heartbeat(", "rpc Beat("),
        ("JOB_STATE_FAILED = 4", "JOB_STATE_FAILED = 6"),
        ("uint64 size_bytes = 3;\n}", "uint32 size_bytes = 3;\n}"),
    ] {
        let changed = released.replace(from, to);
        assert_ne!(changed, released, "{from}");
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("ign/v1/ign.proto");
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, changed).unwrap();
        let before = facts(&current());
        assert!(!facts(&compile(root.path())).is_superset(&before), "{from}");
    }
}

/// What a newer peer adds is skipped.
#[test]
fn unknown_fields_are_skipped() {
    let lease = ign_proto::v1::Lease {
        job_id: "j".to_owned(),
        attempt: 3,
        ..Default::default()
    };
    let mut bytes = lease.encode_to_vec();
    // Field 999, a string; field 1000, a number.
    bytes.extend([0xba, 0x3e, 3, b'n', b'e', b'w', 0xc0, 0x3e, 7]);
    let read = ign_proto::v1::Lease::decode(bytes.as_slice()).unwrap();
    assert_eq!(read, lease);
}

/// A worker whose clock is wrong harms nothing: the only times that it sends are those of its log lines, which are shown
/// and decide nothing.
#[test]
fn a_worker_sends_no_time_but_that_of_its_log_lines() {
    let set = current();
    let file = set
        .file
        .iter()
        .find(|file| file.package() == "ign.v1")
        .unwrap();
    let messages: BTreeMap<String, &DescriptorProto> = file
        .message_type
        .iter()
        .map(|message| (format!(".ign.v1.{}", message.name()), message))
        .collect();
    let workers = file
        .service
        .iter()
        .find(|service| service.name() == "Workers")
        .unwrap();
    let mut open: Vec<String> = workers
        .method
        .iter()
        .map(|method| method.input_type().to_owned())
        .collect();
    let (mut seen, mut times) = (BTreeSet::new(), BTreeSet::new());
    while let Some(name) = open.pop() {
        if !seen.insert(name.clone()) {
            continue;
        }
        for field in messages
            .get(&name)
            .map_or(&[][..], |message| &message.field)
        {
            if field.type_name() == ".google.protobuf.Timestamp" {
                times.insert(format!("{name}.{}", field.name()));
            }
            open.push(field.type_name().to_owned());
        }
    }
    assert_eq!(times, [".ign.v1.LogLine.at".to_owned()].into());
}
