//! `ign.v1.Collections`: shares, limits, pause, webhooks.

use std::sync::Arc;

use ign_proto::v1::collections_server::Collections;
use ign_proto::{Cause, CollectionId, Scope, v1};
use ign_queue::Secret;
use tonic::{Request, Response, Status};

use crate::app::App;
use crate::auth::caller;
use crate::convert::{collection, optional, parsed, to_collection, to_delivery, to_webhook};
use crate::http_answer::Refused;

const DEFAULT_DELIVERIES: u32 = 100;

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

    async fn set_webhook(&self, request: Request<v1::SetWebhookRequest>) -> Answer<v1::Webhook> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let collection = parsed(&request.collection, "collection")?;
        caller.require(&[Scope::Admin], &collection)?;
        self.0
            .receivers
            .check(&request.url)
            .map_err(|why| Refused(Cause::bad_field("url", why)))?;
        let webhook = self
            .0
            .store
            .set_webhook(&collection, &request.url, Secret(request.secret))
            .await
            .map_err(Refused::from)?;
        tracing::info!(%collection, by = caller.name, "webhook set");
        Ok(Response::new(to_webhook(&webhook)))
    }

    async fn remove_webhook(
        &self,
        request: Request<v1::RemoveWebhookRequest>,
    ) -> Answer<v1::RemoveWebhookResponse> {
        let caller = caller(request.extensions())?;
        let collection = parsed(&request.get_ref().collection, "collection")?;
        caller.require(&[Scope::Admin], &collection)?;
        self.0
            .store
            .remove_webhook(&collection)
            .await
            .map_err(Refused::from)?;
        tracing::info!(%collection, by = caller.name, "webhook removed");
        Ok(Response::new(v1::RemoveWebhookResponse {}))
    }

    async fn list_webhooks(
        &self,
        request: Request<v1::ListWebhooksRequest>,
    ) -> Answer<v1::ListWebhooksResponse> {
        let caller = caller(request.extensions())?;
        let only: Option<CollectionId> = optional(&request.get_ref().collection, "collection")?;
        if let Some(collection) = &only {
            caller.require(&[Scope::Admin], collection)?;
        }
        let mut webhooks = self.0.store.webhooks().await.map_err(Refused::from)?;
        webhooks.retain(|it| {
            only.as_ref().is_none_or(|only| *only == it.collection)
                && caller.may(Scope::Admin, &it.collection)
        });
        Ok(Response::new(v1::ListWebhooksResponse {
            webhooks: webhooks.iter().map(to_webhook).collect(),
        }))
    }

    async fn list_deliveries(
        &self,
        request: Request<v1::ListDeliveriesRequest>,
    ) -> Answer<v1::ListDeliveriesResponse> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let collection = parsed(&request.collection, "collection")?;
        caller.require(&[Scope::Admin], &collection)?;
        let limit = if request.limit == 0 {
            DEFAULT_DELIVERIES
        } else {
            request.limit
        };
        let deliveries = self
            .0
            .store
            .deliveries(&collection, limit)
            .await
            .map_err(Refused::from)?;
        Ok(Response::new(v1::ListDeliveriesResponse {
            deliveries: deliveries.iter().map(to_delivery).collect(),
        }))
    }

    async fn redeliver(&self, request: Request<v1::RedeliverRequest>) -> Answer<v1::Delivery> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let collection = parsed(&request.collection, "collection")?;
        caller.require(&[Scope::Admin], &collection)?;
        let delivery = self
            .0
            .store
            .redeliver(&collection, &request.id)
            .await
            .map_err(Refused::from)?;
        Ok(Response::new(to_delivery(&delivery)))
    }
}
