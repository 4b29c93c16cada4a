//! `ign.v1.Admin`: what an operator does to the registry as a whole, and to workers.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use ign_proto::v1::admin_server::Admin;
use ign_proto::{Cause, WorkerId, v1};
use ign_registry::Tally;
use tonic::{Request, Response, Status};

use crate::app::App;
use crate::care::outcome_word;
use crate::convert::{parsed, to_timestamp, to_worker};
use crate::http_answer::Refused;
use crate::trace;

const DEFAULT_EVENTS: u32 = 100;

type Answer<T> = Result<Response<T>, Status>;

/// Serves `ign.v1.Admin`.
pub(crate) struct AdminApi(pub(crate) Arc<App>);

/// Runs to its end also when the client leaves.
async fn to_its_end<T: Send + 'static>(
    work: impl Future<Output = Result<T, Refused>> + Send + 'static,
) -> Result<T, Refused> {
    trace::spawn(work)
        .await
        .map_err(|error| Refused(crate::error::internal(&error)))?
}

fn to_tally(tally: Tally) -> v1::Tally {
    v1::Tally {
        objects: tally.objects,
        bytes: tally.bytes,
    }
}

#[tonic::async_trait]
impl Admin for AdminApi {
    async fn rebuild_registry(
        &self,
        _request: Request<v1::RebuildRegistryRequest>,
    ) -> Answer<v1::RebuildRegistryResponse> {
        let app = self.0.clone();
        let rebuilt = to_its_end(async move { app.rebuild().await }).await?;
        Ok(Response::new(v1::RebuildRegistryResponse {
            added: rebuilt.added,
            known: rebuilt.known,
            faults: rebuilt
                .faults
                .into_iter()
                .map(|(path, reason)| v1::RegistryFault {
                    path,
                    reason,
                    outcome: String::new(),
                })
                .collect(),
        }))
    }

    async fn collect_garbage(
        &self,
        request: Request<v1::CollectGarbageRequest>,
    ) -> Answer<v1::CollectGarbageResponse> {
        let request = request.into_inner();
        let grace = Duration::try_from_secs_f64(request.grace_secs)
            .map_err(|error| Refused(Cause::bad_field("grace_secs", error)))?;
        let app = self.0.clone();
        let collected =
            to_its_end(async move { app.collect(grace, request.dry_run).await }).await?;
        Ok(Response::new(v1::CollectGarbageResponse {
            named: Some(to_tally(collected.named)),
            young: Some(to_tally(collected.young)),
            trashed: Some(to_tally(collected.trashed)),
            waiting: Some(to_tally(collected.waiting)),
            rescued: Some(to_tally(collected.rescued)),
            deleted: Some(to_tally(collected.deleted)),
        }))
    }

    async fn audit_registry(
        &self,
        _request: Request<v1::AuditRegistryRequest>,
    ) -> Answer<v1::AuditRegistryResponse> {
        let app = self.0.clone();
        let audit = to_its_end(async move { app.audit(None).await }).await?;
        Ok(Response::new(v1::AuditRegistryResponse {
            read: Some(to_tally(audit.read)),
            faults: audit
                .faults
                .into_iter()
                .map(|fault| v1::RegistryFault {
                    path: fault.path,
                    reason: fault.reason,
                    outcome: outcome_word(fault.outcome).to_owned(),
                })
                .collect(),
        }))
    }

    async fn list_events(
        &self,
        request: Request<v1::ListEventsRequest>,
    ) -> Answer<v1::ListEventsResponse> {
        let request = request.into_inner();
        let limit = if request.limit == 0 {
            DEFAULT_EVENTS
        } else {
            request.limit
        };
        let events = self.0.store.events(request.before_seq, limit).await;
        Ok(Response::new(v1::ListEventsResponse {
            events: events
                .map_err(Refused::from)?
                .into_iter()
                .map(|event| v1::Event {
                    seq: event.seq,
                    at: Some(to_timestamp(event.at)),
                    kind: event.kind,
                    subject: event.subject,
                    message: event.message,
                })
                .collect(),
        }))
    }

    async fn drain_workers(
        &self,
        request: Request<v1::DrainWorkersRequest>,
    ) -> Answer<v1::DrainWorkersResponse> {
        let request = request.into_inner();
        let mut ids: BTreeSet<WorkerId> = BTreeSet::new();
        for id in &request.worker_ids {
            ids.insert(parsed(id, "worker_ids")?);
        }
        let store = &self.0.store;
        if ids.is_empty() {
            let workers = store.workers().await.map_err(Refused::from)?;
            ids.extend(workers.into_iter().map(|worker| worker.info.id));
        }
        for id in &ids {
            store
                .drain_worker(id, request.draining)
                .await
                .map_err(Refused::from)?;
            tracing::info!(worker.id = %id, draining = request.draining, "drain set");
        }
        let mut workers = store.workers().await.map_err(Refused::from)?;
        workers.retain(|worker| ids.contains(&worker.info.id));
        Ok(Response::new(v1::DrainWorkersResponse {
            workers: workers.iter().map(to_worker).collect(),
        }))
    }

    async fn diagnose(
        &self,
        _request: Request<v1::DiagnoseRequest>,
    ) -> Answer<v1::DiagnoseResponse> {
        let checks = self.0.diagnose().await;
        Ok(Response::new(v1::DiagnoseResponse { checks }))
    }
}
