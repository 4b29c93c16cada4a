//! `ign.v1.Collections`: shares, limits, pause.

use std::sync::Arc;

use ign_proto::v1::collections_server::Collections;
use ign_proto::{Scope, v1};
use tonic::{Request, Response, Status};

use crate::app::App;
use crate::auth::caller;
use crate::convert::{collection, to_collection};
use crate::http_answer::Refused;

type Answer<T> = Result<Response<T>, Status>;

/// Serves `ign.v1.Collections`.
pub(crate) struct CollectionsApi(pub(crate) Arc<App>);

#[tonic::async_trait]
impl Collections for CollectionsApi {
    async fn list(
        &self,
        request: Request<v1::ListCollectionsRequest>,
    ) -> Answer<v1::ListCollectionsResponse> {
        let reach = caller(request.extensions())?.reach(Scope::Read);
        let mut collections = self.0.store.collections().await.map_err(Refused::from)?;
        collections.retain(|it| reach.contains(&it.name));
        Ok(Response::new(v1::ListCollectionsResponse {
            collections: collections.iter().map(to_collection).collect(),
        }))
    }

    async fn set(&self, request: Request<v1::Collection>) -> Answer<v1::Collection> {
        let collection = collection(request.get_ref())?;
        caller(request.extensions())?.require(&[Scope::Admin], &collection.name)?;
        let collection = self
            .0
            .store
            .set_collection(collection)
            .await
            .map_err(Refused::from)?;
        tracing::info!(collection = %collection.name, weight = collection.weight, paused = collection.paused, "collection set");
        Ok(Response::new(to_collection(&collection)))
    }
}
