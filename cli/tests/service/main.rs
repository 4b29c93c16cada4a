//! ignctl as a user runs it, against the real embedded coordinator; the worker is played by the test.

#![expect(
    clippy::unwrap_used,
    reason = "a test fails by panicking; the message of the panic is the report"
)]

mod bulk;
mod harness;
mod worker;

use std::time::Duration;

use harness::{Service, capture, run, stderr, stdout};
use ign_proto::v1;
use serde_json::Value;
use worker::FakeWorker;

fn in_background(work: impl FnOnce() + Send + 'static) -> std::thread::JoinHandle<()> {
    std::thread::Builder::new()
        .name("worker".into())
        .spawn(work)
        .unwrap()
}

fn json(output: &std::process::Output) -> Value {
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {} {}", stdout(output), stderr(output)))
}

#[test]
fn help_and_usage_errors() {
    let help = run(&["--help"], &[]);
    assert_eq!(help.status.code(), Some(0));
    insta::assert_snapshot!(stdout(&help));
    for command in [
        "up", "bake", "submit", "status", "wait", "webhook", "worker", "bundle", "admin",
    ] {
        let help = run(&[command, "--help"], &[]);
        assert_eq!(help.status.code(), Some(0), "{command}");
        insta::assert_snapshot!(format!("help_{command}"), stdout(&help));
    }
    for wrong in [
        &["bake"][..],
        &["bake", "/none", "--object", "museum/vase"],
        &["bake", ".", "--object", "Museum/Vase"],
        &[
            "bake",
            ".",
            "--object",
            "museum/vase",
            "--set",
            "crop=middle",
        ],
        &["submit", ".", "--object", "a/b", "--collection", "c"],
        &["wait", "0192", "--timeout", "soon"],
    ] {
        let output = run(wrong, &[]);
        assert_eq!(
            output.status.code(),
            Some(2),
            "{wrong:?}: {}",
            stderr(&output)
        );
        assert_eq!(stdout(&output), "", "{wrong:?}");
    }
    let completions = run(&["completions", "bash"], &[]);
    assert!(stdout(&completions).contains("ignctl"));
}

#[test]
fn an_unreachable_coordinator_is_exit_3_with_a_hint() {
    let data = tempfile::tempdir().unwrap();
    let output = run(&["--data", data.path().to_str().unwrap(), "status"], &[]);
    assert_eq!(output.status.code(), Some(3));
    insta::assert_snapshot!(stderr(&output).replace(data.path().to_str().unwrap(), "DATA"));
    let output = run(&["--server", "http://127.0.0.1:1", "jobs", "list"], &[]);
    assert_eq!(output.status.code(), Some(3), "{}", stderr(&output));
}

#[test]
fn submit_is_idempotent_and_jobs_can_be_looked_at() {
    let service = Service::start();
    let captures = tempfile::tempdir().unwrap();
    let dir = capture(captures.path(), "Vase 12");
    capture(captures.path(), "bust");
    let path = captures.path().to_str().unwrap();

    let first = service.run(&["submit", path, "--collection", "museum", "-o", "json"]);
    assert_eq!(first.status.code(), Some(0), "{}", stderr(&first));
    let rows = json(&first);
    assert_eq!(rows.as_array().unwrap().len(), 2);
    assert_eq!(
        (&rows[0]["object"], &rows[0]["outcome"]),
        (&"vase-12".into(), &"submitted".into())
    );
    assert_eq!(rows[0]["job"]["state"], "queued");

    std::thread::sleep(Duration::from_millis(5));
    let again = json(&service.run(&["submit", path, "--collection", "museum", "-o", "json"]));
    assert_eq!(again[0]["outcome"], "known");
    assert_eq!(again[0]["job"]["id"], rows[0]["job"]["id"]);
    let object = ["--object", "museum/vase-12"];
    let anew = service.run(
        &[
            &["submit", dir.to_str().unwrap(), "--again", "-o", "json"][..],
            &object,
        ]
        .concat(),
    );
    assert_ne!(json(&anew)[0]["job"]["id"], rows[0]["job"]["id"]);

    let list = json(&service.run(&["jobs", "list", "-o", "json"]));
    assert_eq!(list.as_array().unwrap().len(), 3);
    let queued = service.run(&[
        "jobs",
        "list",
        "--state",
        "queued",
        "--object",
        "museum/bust",
        "-o",
        "json",
    ]);
    assert_eq!(json(&queued).as_array().unwrap().len(), 1);
    let none = service.run(&["jobs", "list", "--collection", "other"]);
    assert_eq!(
        (stdout(&none).as_str(), stderr(&none).as_str()),
        ("", "no job\n")
    );

    let id = rows[1]["job"]["id"].as_str().unwrap();
    // Jobs of one millisecond have more than half of their ids in common.
    for name in [id, &id[..32], "museum/bust"] {
        let job = json(&service.run(&["jobs", "get", name, "-o", "json"]));
        assert_eq!(job["id"], id, "{name}");
    }
    let missing = service.run(&["jobs", "get", "ffffffff"]);
    assert_eq!(missing.status.code(), Some(1));

    let timeout = service.run(&["wait", id, "--timeout", "0.3s"]);
    assert_eq!(timeout.status.code(), Some(4), "{}", stderr(&timeout));
    let cancelled = json(&service.run(&["cancel", id, "-o", "json"]));
    assert_eq!(cancelled[0]["state"], "cancelled");
    let ended = service.run(&["wait", id, "--timeout", "5s"]);
    assert_eq!(ended.status.code(), Some(1));
    let retried = json(&service.run(&["retry", id, "-o", "json"]));
    assert_eq!(retried[0]["state"], "queued");

    let table = stdout(&service.run(&["jobs", "list"]));
    assert!(
        !table.contains('\x1b') && table.starts_with("JOB"),
        "{table}"
    );
    let status = json(&service.run(&["status", "-o", "json"]));
    assert_eq!(status["jobs_by_state"]["queued"], 3);
    let yaml: Value =
        serde_yaml_ng::from_str(&stdout(&service.run(&["status", "-o", "yaml"]))).unwrap();
    assert_eq!(yaml["jobs_by_state"], status["jobs_by_state"]);
}

#[test]
fn a_list_is_checked_whole_before_anything_is_sent() {
    let service = Service::start();
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path(), "a");
    let list = dir.path().join("list.csv");
    std::fs::write(
        &list,
        "path,collection,object,size\na,museum,vase,128\nnone,museum,bust,\na,museum,VASE,1\n",
    )
    .unwrap();
    let list = list.to_str().unwrap();
    let refused = service.run(&["submit", "--manifest", list]);
    assert_eq!(refused.status.code(), Some(2));
    insta::assert_snapshot!(stderr(&refused).replace(dir.path().to_str().unwrap(), "DIR"));
    assert_eq!(
        json(&service.run(&["jobs", "list", "-o", "json"])),
        serde_json::json!([])
    );

    std::fs::write(
        list,
        "path,collection,object,size,priority\na,museum,vase,128,5\n",
    )
    .unwrap();
    let rows = json(&service.run(&["submit", "--manifest", list, "-o", "json"]));
    assert_eq!(rows[0]["job"]["recipe"]["size"], 128);
    assert_eq!(rows[0]["job"]["priority"], 5);
}

#[test]
fn a_dry_run_needs_no_service_and_names_faults() {
    let dir = tempfile::tempdir().unwrap();
    let bad = capture(dir.path(), "bad");
    let output = run(
        &[
            "submit",
            bad.to_str().unwrap(),
            "--object",
            "museum/bad",
            "--dry-run",
        ],
        &[],
    );
    assert_eq!(output.status.code(), Some(1));
    let text = stdout(&output);
    assert!(
        text.contains("error: ") && text.contains("hint: "),
        "{text}"
    );
}

#[test]
fn a_bake_ends_with_everything_in_its_folder() {
    let service = Service::start();
    let work = tempfile::tempdir().unwrap();
    let dir = capture(work.path(), "vase");
    let out = work.path().join("out");
    let worker = FakeWorker::new(&service);
    let baker = in_background(move || {
        worker.run_one(|worker, lease| async move {
            worker.progress(&lease, "composition", 41.0).await;
            worker.log(&lease, "info", "epoch 5 of 12").await;
            worker.publish(&lease).await;
        });
    });
    let args = [
        "bake",
        dir.to_str().unwrap(),
        "--object",
        "museum/vase",
        "--out",
        out.to_str().unwrap(),
    ];
    let baked = service.run(&args);
    baker.join().unwrap();
    assert_eq!(baked.status.code(), Some(0), "{}", stderr(&baked));
    let text = stdout(&baked).replace(out.to_str().unwrap(), "OUT");
    insta::with_settings!({filters => vec![(r"[\d.]+ kB", "[SIZE]")]}, {
        insta::assert_snapshot!(text);
    });
    for file in [
        "bundle/bundle.json",
        "metrics.json",
        "report.html",
        "held_out/a.ours.png",
    ] {
        assert!(out.join(file).is_file(), "{file}");
    }
    assert!(
        stderr(&baked).contains("composition 41%"),
        "{}",
        stderr(&baked)
    );
    assert_eq!(
        std::fs::read_dir(work.path()).unwrap().count(),
        2,
        "nothing is left beside it"
    );

    let logs = stdout(&service.run(&["logs", "museum/vase"]));
    assert!(logs.contains("epoch 5 of 12"), "{logs}");

    let list = json(&service.run(&["bundle", "list", "museum", "-o", "json"]));
    assert_eq!(
        (&list[0]["version"], &list[0]["aliases"][0]),
        (&1.into(), &"latest".into())
    );
    let tagged = service.run(&["bundle", "tag", "museum/vase:v1", "approved"]);
    assert_eq!(tagged.status.code(), Some(0), "{}", stderr(&tagged));
    let shown = json(&service.run(&["bundle", "show", "museum/vase:approved", "-o", "json"]));
    assert_eq!(shown["version"], 1);
    let remote = service.run(&["bundle", "verify", "museum/vase"]);
    assert_eq!(remote.status.code(), Some(0), "{}", stderr(&remote));
    let local = service.run(&["bundle", "verify", out.to_str().unwrap()]);
    assert_eq!(local.status.code(), Some(0), "{}", stderr(&local));

    let fetched = work.path().join("fetched");
    let fetch = [
        "bundle",
        "fetch",
        "museum/vase",
        "--out",
        fetched.to_str().unwrap(),
    ];
    assert_eq!(service.run(&fetch).status.code(), Some(0));
    assert!(fetched.join("bundle.json").is_file());

    let page = work.path().join("museum.html");
    let report = ["report", "museum", "--out", page.to_str().unwrap()];
    let written = service.run(&report);
    assert_eq!(written.status.code(), Some(0), "{}", stderr(&written));
    insta::assert_snapshot!(
        "report_of_a_collection",
        stdout(&written).replace(page.to_str().unwrap(), "PAGE")
    );
    let text = std::fs::read_to_string(&page).unwrap();
    assert!(text.contains("<h1>museum</h1>") && text.ends_with("</html>\n"));
    let nobody = service.run(&["report", "nobody", "--out", page.to_str().unwrap()]);
    assert_eq!(nobody.status.code(), Some(1), "{}", stderr(&nobody));
    assert_eq!(
        std::fs::read_to_string(&page).unwrap(),
        text,
        "the former page stays"
    );

    // A damaged file is found, on disk and in the store.
    std::fs::write(out.join("bundle/report.html"), "changed").unwrap();
    assert_eq!(
        service
            .run(&["bundle", "verify", out.to_str().unwrap()])
            .status
            .code(),
        Some(1)
    );
    service.damage_blob("<p>ours</p>");
    let refused = service.run(&fetch);
    assert_eq!(refused.status.code(), Some(1), "{}", stderr(&refused));
    assert!(
        fetched.join("bundle.json").is_file(),
        "the former result stays"
    );

    // A folder that is somebody else's is not touched.
    let foreign = work.path().join("thesis");
    std::fs::create_dir(&foreign).unwrap();
    std::fs::write(foreign.join("chapter.tex"), "").unwrap();
    let args = [
        "bake",
        dir.to_str().unwrap(),
        "--object",
        "museum/vase",
        "--out",
        foreign.to_str().unwrap(),
    ];
    assert_eq!(service.run(&args).status.code(), Some(2));
}

#[test]
fn a_failed_bake_says_what_where_and_how_to_fix_it() {
    let service = Service::start();
    let work = tempfile::tempdir().unwrap();
    let empty = work.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    let worker = FakeWorker::new(&service);
    let baker = in_background(move || {
        worker.run_one(|worker, lease| async move {
            let failure = v1::Failure {
                kind: v1::FailureKind::InvalidInput.into(),
                message: "the proxy mesh is missing".into(),
                at: "mesh.ply".into(),
                hint: "put the proxy there".into(),
            };
            worker.fail(&lease, failure).await;
        });
    });
    let out = work.path().join("out");
    let baked = service.run(&[
        "bake",
        empty.to_str().unwrap(),
        "--object",
        "museum/none",
        "--out",
        out.to_str().unwrap(),
    ]);
    baker.join().unwrap();
    assert_eq!(baked.status.code(), Some(1));
    assert_eq!(stdout(&baked), "");
    let text = stderr(&baked);
    let tail: Vec<&str> = text.lines().rev().take(3).collect();
    assert_eq!(
        tail,
        [
            " hint: put the proxy there",
            "   at: mesh.ply",
            "error: the proxy mesh is missing"
        ]
    );
    assert!(!out.exists());
    let status = json(&service.run(&["status", "-o", "json"]));
    assert_eq!(
        status["recent_failures"][0]["failure"]["kind"],
        "invalid_input"
    );
}

#[test]
fn an_interrupted_bake_leaves_its_job_to_a_service_and_a_repeated_one_joins_it() {
    let service = Service::start();
    let work = tempfile::tempdir().unwrap();
    let dir = capture(work.path(), "vase");
    let args = ["bake", dir.to_str().unwrap(), "--object", "museum/vase"];
    let bake = |name: &str| service.spawn(&args, &work.path().join(name));
    let first = bake("first.log");
    service.wait_for_jobs(1);
    let said = first.interrupt("bakes museum/vase");
    assert!(said.contains("goes on"), "{said}");
    let jobs = json(&service.run(&["jobs", "list", "-o", "json"]));
    assert_eq!(jobs[0]["state"], "queued");
    let second = bake("second.log");
    let said = second.interrupt("bakes museum/vase");
    assert!(said.contains("joining"), "{said}");
    service.wait_for_jobs(1);
}

#[test]
fn waiting_survives_a_killed_coordinator() {
    let mut service = Service::start();
    let work = tempfile::tempdir().unwrap();
    let dir = capture(work.path(), "vase");
    let submit = [
        "submit",
        dir.to_str().unwrap(),
        "--object",
        "museum/vase",
        "-o",
        "json",
    ];
    let id = json(&service.run(&submit))[0]["job"]["id"]
        .as_str()
        .unwrap()
        .to_string();
    let waiting = service.spawn_on_server(&["wait", &id], &work.path().join("wait.log"));
    std::thread::sleep(Duration::from_millis(300));
    service.kill_and_restart();
    let cancelled = json(&service.run(&["cancel", &id, "-o", "json"]));
    assert_eq!(cancelled[0]["state"], "cancelled");
    let (code, said) = waiting.ended();
    assert_eq!(code, Some(1), "{said}");
}

#[test]
fn a_second_service_on_the_same_folder_is_refused() {
    let service = Service::start();
    let refused = service.run(&["up", "--workers", "0"]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(stderr(&refused).contains("already"), "{}", stderr(&refused));
    let doctor = service.run(&["doctor", "-o", "json"]);
    let checks = json(&doctor);
    let state = |name: &str| {
        let checks = checks.as_array().unwrap();
        checks
            .iter()
            .find(|check| check["name"] == name)
            .map(|check| check["state"].clone())
            .unwrap()
    };
    for name in [
        "server",
        "token",
        "database",
        "database clock",
        "store",
        "server disk",
        "version",
        "clock",
        "data folder",
    ] {
        assert_eq!(state(name), "ok", "{name}: {checks}");
    }
    let store = checks.as_array().unwrap();
    let store = store.iter().find(|check| check["name"] == "store").unwrap();
    let detail = store["detail"].as_str().unwrap();
    assert!(detail.contains("honours conditional put"), "{detail}");
}

#[test]
fn a_wrong_token_is_refused() {
    let service = Service::start();
    let dir = tempfile::tempdir().unwrap();
    let token = dir.path().join("token");
    std::fs::write(&token, "wrong").unwrap();
    let refused = service.run(&["--token-file", token.to_str().unwrap(), "jobs", "list"]);
    assert_eq!(refused.status.code(), Some(1));
    insta::assert_snapshot!(stderr(&refused));
}

#[test]
fn a_bake_of_its_own_ends_when_its_worker_cannot_run() {
    let work = tempfile::tempdir().unwrap();
    let dir = capture(work.path(), "vase");
    let worker = harness::script(
        work.path(),
        "worker",
        "echo 'cannot open libtorch_cpu.so' >&2; exit 127",
    );
    let data = work.path().join("data");
    let args = [
        "--data",
        data.to_str().unwrap(),
        "bake",
        dir.to_str().unwrap(),
        "--object",
        "museum/vase",
    ];
    let baked = run(&args, &[("IGN_WORKER", worker.to_str().unwrap())]);
    assert_eq!(baked.status.code(), Some(1));
    assert!(
        stderr(&baked).contains("hint: cannot open libtorch_cpu.so"),
        "{}",
        stderr(&baked)
    );
    // The folder is free again, and the job is still there.
    let service = Service::on(&data);
    service.wait_for_jobs(1);
}

#[test]
fn a_bake_whose_service_ends_goes_on_with_its_own() {
    let work = tempfile::tempdir().unwrap();
    let dir = capture(work.path(), "vase");
    let worker = harness::script(work.path(), "worker", "cat > /dev/null");
    let data = work.path().join("data");
    let service = Service::on(&data);
    let args = [
        "--data",
        data.to_str().unwrap(),
        "bake",
        dir.to_str().unwrap(),
        "--object",
        "museum/vase",
    ];
    let env = [("IGN_WORKER", worker.to_str().unwrap())];
    let bake = harness::spawn(&args, &env, &work.path().join("log"));
    service.wait_for_jobs(1);
    drop(service);
    let said = bake.interrupt("joining");
    assert!(said.contains("service started for this bake"), "{said}");
    let service = Service::on(&data);
    let jobs = json(&service.run(&["jobs", "list", "-o", "json"]));
    assert_eq!(jobs.as_array().unwrap().len(), 1);
    assert_eq!(jobs[0]["state"], "cancelled");
}

#[test]
fn ctrl_c_cancels_the_job_of_a_bake_of_its_own() {
    let work = tempfile::tempdir().unwrap();
    let dir = capture(work.path(), "vase");
    let worker = harness::script(work.path(), "worker", "cat > /dev/null");
    let data = work.path().join("data");
    let args = [
        "--data",
        data.to_str().unwrap(),
        "bake",
        dir.to_str().unwrap(),
        "--object",
        "museum/vase",
    ];
    let bake = harness::spawn(
        &args,
        &[("IGN_WORKER", worker.to_str().unwrap())],
        &work.path().join("log"),
    );
    bake.interrupt("bakes museum/vase");
    let service = Service::on(&data);
    let jobs = json(&service.run(&["jobs", "list", "-o", "json"]));
    assert_eq!(jobs[0]["state"], "cancelled");
}

#[test]
fn tokens_are_made_used_rotated_and_revoked() {
    let service = Service::start();
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("reader");
    let file = file.to_str().unwrap();
    let create = [
        "token",
        "create",
        "reader",
        "--allow",
        "read:museum",
        "--expires",
        "1h",
        "--out",
        file,
    ];
    let made = service.run(&create);
    assert_eq!(made.status.code(), Some(0), "{}", stderr(&made));
    let secret = std::fs::read_to_string(file).unwrap();
    assert!(secret.starts_with("ign_"));
    // No place, no token.
    let again = [
        "token", "create", "other", "--allow", "read:*", "--out", file,
    ];
    assert_eq!(service.run(&again).status.code(), Some(2));
    let listed = service.run(&["token", "list", "-o", "json"]);
    for output in [&made, &listed] {
        assert!(!stdout(output).contains(secret.trim()) && !stderr(output).contains(secret.trim()));
    }
    let listed: serde_json::Value = serde_json::from_str(&stdout(&listed)).unwrap();
    assert_eq!(listed.as_array().unwrap().len(), 1);
    assert_eq!(
        (&listed[0]["allows"][0], &listed[0]["state"]),
        (&"read:museum".into(), &"ok".into())
    );

    let list_jobs = || {
        service.run(&[
            "--token-file",
            file,
            "jobs",
            "list",
            "--collection",
            "museum",
        ])
    };
    assert_eq!(list_jobs().status.code(), Some(0));
    let refused = service.run(&["--token-file", file, "token", "list"]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(
        stderr(&refused).contains("it takes admin in every collection"),
        "{}",
        stderr(&refused)
    );

    // The secret alone on stdout, to be piped.
    let rotated = service.run(&["token", "rotate", "reader", "--grace", "0s"]);
    assert_eq!(rotated.status.code(), Some(0), "{}", stderr(&rotated));
    assert_eq!(list_jobs().status.code(), Some(1));
    std::fs::write(file, &rotated.stdout).unwrap();
    assert_eq!(list_jobs().status.code(), Some(0));
    assert_eq!(
        service.run(&["token", "revoke", "reader"]).status.code(),
        Some(0)
    );
    assert_eq!(list_jobs().status.code(), Some(1));
}

/// Collecting needs a yes; the rest can be run by a timer.
#[test]
fn an_operator_cares_for_the_registry() {
    let service = Service::start();
    let asked = service.run(&["admin", "gc"]);
    assert_eq!(asked.status.code(), Some(1), "{}", stderr(&asked));
    assert!(stderr(&asked).contains("--yes"), "{}", stderr(&asked));
    let dry = json(&service.run(&["admin", "gc", "--dry-run", "-o", "json"]));
    assert_eq!(dry["dry_run"], true);
    assert_eq!(dry["trashed"]["objects"], 0);
    let done = json(&service.run(&["admin", "gc", "--grace", "2h", "--yes", "-o", "json"]));
    assert_eq!(done["dry_run"], false);
    let short = service.run(&["admin", "gc", "--grace", "10m", "--dry-run"]);
    assert!(
        stderr(&short).contains("at least 3600 s"),
        "{}",
        stderr(&short)
    );
    let rebuilt = json(&service.run(&["admin", "rebuild-registry", "-o", "json"]));
    assert_eq!(rebuilt["added"], 0);
    let audit = json(&service.run(&["admin", "audit", "-o", "json"]));
    assert_eq!(audit["read"]["objects"], 1, "OCI's empty config: {audit}");
    let events = json(&service.run(&["admin", "events", "-o", "json"]));
    let kinds: Vec<&str> = events
        .as_array()
        .unwrap()
        .iter()
        .map(|event| event["kind"].as_str().unwrap())
        .collect();
    assert_eq!(kinds, ["audit", "rebuild", "collect"]);
}

#[test]
fn workers_are_drained_and_come_back() {
    let service = Service::start();
    let parent = tempfile::tempdir().unwrap();
    let folder = capture(parent.path(), "vase");
    let submitted = service.run(&[
        "submit",
        folder.to_str().unwrap(),
        "--object",
        "museum/vase",
    ]);
    assert_eq!(submitted.status.code(), Some(0), "{}", stderr(&submitted));
    let worker = FakeWorker::new(&service);
    worker.run_one(async |worker, lease| worker.publish(&lease).await);

    let draining = |args: &[&str]| {
        let workers = json(&service.run(&[&["worker"], args, &["-o", "json"]].concat()));
        assert_eq!(workers.as_array().unwrap().len(), 1);
        assert_eq!(workers[0]["id"], worker::NAME);
        workers[0]["draining"].as_bool().unwrap()
    };
    assert!(!draining(&["list"]));
    assert!(draining(&["drain", worker::NAME]));
    assert!(draining(&["list"]));
    let shown = service.run(&["status"]);
    assert!(stdout(&shown).contains("draining"), "{}", stdout(&shown));
    assert!(!draining(&["undrain", "--all"]));
    let nobody = service.run(&["worker", "drain", "nobody"]);
    assert_eq!(nobody.status.code(), Some(1));
    assert!(stderr(&nobody).contains("nobody"), "{}", stderr(&nobody));
    assert_eq!(service.run(&["worker", "drain"]).status.code(), Some(2));
}
