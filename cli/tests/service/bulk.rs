//! Submitting much, again and again: nothing is sent twice.

use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::Value;

use crate::harness::{Service, capture, run, spawn, stderr, wait_until};
use crate::{in_background, json};

/// Passes connections on to a service, counts what clients send, and slows them down.
struct Proxy {
    address: SocketAddr,
    sent: Arc<AtomicU64>,
    heads: Arc<Mutex<Vec<String>>>,
}

impl Proxy {
    fn before(service: &Service, bytes_per_sec: u64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let to = service
            .url()
            .trim_start_matches("http://")
            .trim_end_matches('/')
            .to_string();
        let proxy = Self {
            address: listener.local_addr().unwrap(),
            sent: Arc::default(),
            heads: Arc::default(),
        };
        let (sent, heads) = (proxy.sent.clone(), proxy.heads.clone());
        in_background(move || {
            for client in listener.incoming() {
                let (mut client, mut server) = (client.unwrap(), TcpStream::connect(&to).unwrap());
                let (mut answers, mut back) =
                    (server.try_clone().unwrap(), client.try_clone().unwrap());
                in_background(move || {
                    // Whichever side leaves ends it.
                    std::io::copy(&mut answers, &mut back).ok();
                    back.shutdown(Shutdown::Write).ok();
                });
                let (sent, heads) = (sent.clone(), heads.clone());
                in_background(move || {
                    let mut buffer = vec![0; 1 << 16];
                    while let Ok(count @ 1..) = client.read(&mut buffer) {
                        sent.fetch_add(count as u64, Ordering::SeqCst);
                        let text = String::from_utf8_lossy(&buffer[..count.min(200)]).into_owned();
                        if let Some(head) = text.lines().next().filter(|it| it.contains(" /v2/")) {
                            heads.lock().unwrap().push(head.to_string());
                        }
                        if server.write_all(&buffer[..count]).is_err() {
                            break;
                        }
                        std::thread::sleep(Duration::from_secs_f64(
                            count as f64 / bytes_per_sec as f64,
                        ));
                    }
                    server.shutdown(Shutdown::Write).ok();
                });
            }
        });
        proxy
    }

    fn sent(&self) -> u64 {
        self.sent.load(Ordering::SeqCst)
    }

    fn take_heads(&self) -> Vec<String> {
        std::mem::take(&mut *self.heads.lock().unwrap())
    }
}

/// `ignctl` through a proxy, with a memory of its own.
struct Client {
    connection: [String; 4],
    memory: tempfile::TempDir,
}

impl Client {
    fn new(service: &Service, proxy: &Proxy) -> Self {
        let token = service.token_file().to_str().unwrap().to_string();
        Self {
            connection: [
                "--server".to_string(),
                format!("http://{}", proxy.address),
                "--token-file".to_string(),
                token,
            ],
            memory: tempfile::tempdir().unwrap(),
        }
    }

    fn args<'a>(&'a self, args: &[&'a str]) -> Vec<&'a str> {
        let connection = self.connection.iter().map(String::as_str);
        connection.chain(args.iter().copied()).collect()
    }

    fn env(&self) -> [(&str, &str); 1] {
        [("XDG_CACHE_HOME", self.memory.path().to_str().unwrap())]
    }

    fn submit(&self, captures: &Path) -> Value {
        let path = captures.to_str().unwrap();
        let args = ["submit", path, "--collection", "museum", "-o", "json"];
        let output = run(&self.args(&args), &self.env());
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        json(&output)
    }

    fn checksum_tables(&self) -> Vec<PathBuf> {
        std::fs::read_dir(self.memory.path().join("ign/checksums"))
            .map(|entries| entries.map(|entry| entry.unwrap().path()).collect())
            .unwrap_or_default()
    }
}

#[test]
fn a_submit_that_was_killed_in_the_middle_of_a_file_sends_no_byte_twice() {
    const MIB: u64 = 1 << 20;
    let service = Service::start();
    let proxy = Proxy::before(&service, 64 * MIB);
    let client = Client::new(&service, &proxy);
    let captures = tempfile::tempdir().unwrap();
    let dir = capture(captures.path(), "vase");
    // Not the same part again and again.
    let bytes: Vec<u8> = (0..48 * MIB).map(|at| (at >> 12) as u8).collect();
    std::fs::write(dir.join("mesh.ply"), &bytes).unwrap();

    let log = captures.path().join("log");
    let path = captures.path().to_str().unwrap();
    let args = client.args(&["submit", path, "--collection", "museum"]);
    let mut killed = 0;
    for mib in [11, 29] {
        let first = spawn(&args, &client.env(), &log);
        wait_until("bytes", || (proxy.sent() > mib * MIB).then_some(()));
        // With SIGKILL.
        drop(first);
        killed = proxy.sent();
        assert!(killed < 45 * MIB, "it was not killed in the middle");
        wait_until("the server to keep what came", || {
            let before = proxy.sent();
            std::thread::sleep(Duration::from_millis(300));
            (proxy.sent() == before).then_some(())
        });
    }
    let rows = client.submit(captures.path());
    assert_eq!(rows[0]["outcome"], "submitted");
    let sent = proxy.sent();
    assert!(killed > 0 && sent >= 48 * MIB, "{sent}");
    // Heads of requests, and calls.
    assert!(sent < 48 * MIB + MIB / 4, "{sent} bytes for {}", 48 * MIB);
    let open = std::fs::read_dir(client.memory.path().join("ign/uploads")).unwrap();
    assert_eq!(open.count(), 0, "uploads that have ended are forgotten");
}

#[test]
fn a_capture_that_is_there_costs_one_question_and_no_reading() {
    let service = Service::start();
    let proxy = Proxy::before(&service, 1 << 30);
    let client = Client::new(&service, &proxy);
    let captures = tempfile::tempdir().unwrap();
    let dir = capture(captures.path(), "vase");
    let image = dir.join("images/a.jpg");
    // Files that were written a moment ago are not trusted to stay as they are.
    let first = client.submit(captures.path());
    assert_eq!(client.checksum_tables().len(), 0);
    let posts = proxy.take_heads();
    assert!(
        posts.iter().any(|head| head.starts_with("POST")),
        "{posts:?}"
    );
    std::thread::sleep(Duration::from_millis(3100));

    let again = client.submit(captures.path());
    assert_eq!(again[0]["job"]["id"], first[0]["job"]["id"]);
    let heads = proxy.take_heads();
    assert_eq!(heads.len(), 1, "{heads:?}");
    assert!(
        heads[0].starts_with("HEAD /v2/museum/vase/manifests/sha256:"),
        "{heads:?}"
    );

    // It believes what it remembers, so it did not read: another checksum gives another capture, which is refused.
    let tables = client.checksum_tables();
    assert_eq!(tables.len(), 2, "one for the folder, one for its images");
    let read = |table: &PathBuf| std::fs::read_to_string(table).unwrap();
    let table = tables.iter().find(|it| read(it).contains("a.jpg")).unwrap();
    let kept = read(table);
    let (before, sum) = kept.split_once("\"sha256\":\"").unwrap();
    let wrong = format!("{before}\"sha256\":\"{}{}", "0".repeat(64), &sum[64..]);
    std::fs::write(table, wrong).unwrap();
    let path = captures.path().to_str().unwrap();
    let submit = ["submit", path, "--collection", "museum"];
    let refused = run(&client.args(&submit), &client.env());
    assert_eq!(refused.status.code(), Some(1), "{}", stderr(&refused));

    // Other bytes of the same length under the old time of modification: the system's own time tells.
    let modified = std::fs::metadata(&image).unwrap().modified().unwrap();
    std::fs::write(table, kept).unwrap();
    std::fs::write(&image, "no picture of vasf").unwrap();
    let file = std::fs::File::options().write(true).open(&image).unwrap();
    file.set_modified(modified).unwrap();
    let changed = client.submit(captures.path());
    assert_eq!(changed[0]["outcome"], "submitted");
    assert_ne!(changed[0]["job"]["id"], first[0]["job"]["id"]);
}

#[test]
fn rows_that_name_one_capture_send_it_once_and_become_a_job_each() {
    let service = Service::start();
    let proxy = Proxy::before(&service, 1 << 30);
    let client = Client::new(&service, &proxy);
    let captures = tempfile::tempdir().unwrap();
    capture(captures.path(), "vase");
    capture(captures.path(), "bust");
    let mut list = String::from("path,collection,object\n");
    for row in 0..1200 {
        let name = ["vase", "bust"][row % 2];
        writeln!(list, "{name},museum,{name}-{row}").unwrap();
    }
    let file = captures.path().join("list.csv");
    std::fs::write(&file, list).unwrap();
    let args = ["submit", "--manifest", file.to_str().unwrap(), "-o", "json"];
    let output = run(&client.args(&args), &client.env());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let rows = json(&output);
    let rows = rows.as_array().unwrap();
    assert_eq!(rows.len(), 1200);
    for (index, row) in rows.iter().enumerate() {
        let name = ["vase", "bust"][index % 2];
        assert_eq!(
            row["object"],
            format!("{name}-{index}"),
            "in the order of the list"
        );
        assert_eq!(row["outcome"], "submitted");
    }
    // Both captures have the same mesh of 9 MiB.
    let sent = proxy.sent();
    assert!(sent < 11 << 20, "{sent} bytes");
}
